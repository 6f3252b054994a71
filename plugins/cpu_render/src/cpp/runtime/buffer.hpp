// Uninitialised, cache-line aligned array that only grows: scratch that lives as long as its Rasterizer.
//
// Large ones are pages of their own and not part of the heap: the heap's large blocks come and go with the temporary
// pictures of every frame, and what lives long between them would keep it from being used again (a tenth of the memory
// of a run with large pictures).
#pragma once
#include <sys/mman.h>

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
  ~Buffer() { give_back(); }

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
  // `count` items, all bytes zero. Pages of a large one are zero as the system hands them out, each when it is first
  // written: what is never written takes no memory.
  T* require_zeros(std::size_t count) {
    release();
    T* data = require(count);
    if (!is_large(bytes())) std::memset(data, 0, bytes());
    return data;
  }
  void release() {
    give_back();
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
    T* fresh = static_cast<T*>(allocate(capacity * sizeof(T)));
    if (keep) std::memcpy(fresh, data_, keep * sizeof(T));
    give_back();
    data_ = fresh;
    capacity_ = capacity;
  }

  static bool is_large(std::size_t bytes) { return bytes >= std::size_t{1} << 20; }

  static void* allocate(std::size_t bytes) {
    if (!is_large(bytes)) {
      if (void* found = std::aligned_alloc(64, (bytes + 63) / 64 * 64)) return found;
      throw std::bad_alloc();
    }
    void* found = mmap(nullptr, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (found == MAP_FAILED) throw std::bad_alloc();
    return found;
  }

  void give_back() {
    if (!is_large(bytes()))
      std::free(data_);
    else
      munmap(data_, bytes());
  }

  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace gsstream_cpu
