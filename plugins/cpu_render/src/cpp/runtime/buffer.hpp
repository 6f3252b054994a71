// Uninitialised, cache-line aligned array that only grows: scratch that lives as long as its Rasterizer.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <new>
#include <type_traits>
#include <utility>

namespace gsstream_cpu {

template <class T>
class Buffer {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // At least `count` items; contents are lost when it has to grow.
  T* require(std::size_t count) {
    if (count > capacity_) reallocate(count, 0);
    return data_;
  }
  // At least `count` items, the first `keep` of them preserved.
  T* require_keeping(std::size_t count, std::size_t keep) {
    if (count > capacity_) reallocate(count, keep);
    return data_;
  }
  void release() {
    std::free(data_);
    data_ = nullptr;
    capacity_ = 0;
  }
  void swap(Buffer& other) {
    std::swap(data_, other.data_);
    std::swap(capacity_, other.capacity_);
  }
  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](std::size_t i) { return data_[i]; }
  const T& operator[](std::size_t i) const { return data_[i]; }
  std::size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  void reallocate(std::size_t count, std::size_t keep) {
    const std::size_t capacity = count + count / 4 + 64;
    const std::size_t size = (capacity * sizeof(T) + 63) / 64 * 64;
    T* fresh = static_cast<T*>(std::aligned_alloc(64, size));
    if (!fresh) throw std::bad_alloc();
    if (keep) std::memcpy(fresh, data_, keep * sizeof(T));
    std::free(data_);
    data_ = fresh;
    capacity_ = capacity;
  }

  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace gsstream_cpu
