// Proof that no other thread runs the same Rasterizer. A thread that has it may take it again.
#pragma once
#include <stdexcept>
#include <thread>

#include "raster/rasterizer.hpp"

namespace gsstream_cpu {

class Rasterizer::Claim {
 public:
  explicit Claim(std::atomic<std::thread::id>& owner) : owner_(owner), again_(owner.load() == std::this_thread::get_id()) {
    std::thread::id nobody;
    if (!again_ && !owner_.compare_exchange_strong(nobody, std::this_thread::get_id()))
      throw std::runtime_error(
          "this Rasterizer is already running in another thread; expected one Rasterizer per camera "
          "and thread. Create a second one.");
  }
  ~Claim() {
    if (!again_) owner_.store({});
  }
  Claim(const Claim&) = delete;
  Claim& operator=(const Claim&) = delete;

 private:
  std::atomic<std::thread::id>& owner_;
  const bool again_;
};

class Rasterizer::Loan {
 public:
  Loan(Rasterizer& to, PassMemory& memory) : to_(to), claim_(to.owner_) {
    to_.drop_pass();
    to_.pass_ = &memory;
  }
  ~Loan() {
    to_.drop_pass();
    to_.pass_ = &to_.own_;
  }
  Loan(const Loan&) = delete;
  Loan& operator=(const Loan&) = delete;

 private:
  Rasterizer& to_;
  const Claim claim_;
};

}  // namespace gsstream_cpu
