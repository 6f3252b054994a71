// Proof that no other thread runs the same Rasterizer.
#pragma once
#include <stdexcept>

#include "raster/rasterizer.hpp"

namespace gsstream_cpu {

class Rasterizer::Claim {
 public:
  explicit Claim(std::atomic<bool>& busy) : busy_(busy) {
    if (busy_.exchange(true))
      throw std::runtime_error(
          "this Rasterizer is already running in another thread; expected one Rasterizer per camera "
          "and thread. Create a second one.");
  }
  ~Claim() { busy_.store(false); }
  Claim(const Claim&) = delete;
  Claim& operator=(const Claim&) = delete;

 private:
  std::atomic<bool>& busy_;
};

}  // namespace gsstream_cpu
