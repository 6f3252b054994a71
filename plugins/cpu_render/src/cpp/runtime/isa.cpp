#include "runtime/isa.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace gsstream_cpu {
namespace {

// -1 until the first use: reading the environment at load time would make a bad value an import error with no context.
std::atomic<int> selected{-1};

std::string names_of(const std::vector<Isa>& isas) {
  std::string text;
  for (Isa isa : isas) text += (text.empty() ? "" : ", ") + std::string(isa_name(isa));
  return text;
}

Isa isa_from_name(const std::string& name, const char* origin) {
  const std::vector<Isa> usable = supported_isas();
  for (Isa isa : usable)
    if (name == isa_name(isa)) return isa;
  throw std::invalid_argument(std::string(origin) + ": expected one of {" + names_of(usable) +
                              "} (the instruction sets this processor runs), got '" + name +
                              "'. Unset it to use the strongest.");
}

}  // namespace

const char* isa_name(Isa isa) {
  switch (isa) {
    case Isa::baseline:
      return "baseline";
    case Isa::avx2:
      return "avx2";
    case Isa::avx512:
      return "avx512";
    case Isa::neon:
      return "neon";
  }
  return "?";
}

std::vector<Isa> supported_isas() {
  std::vector<Isa> found;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt")) found.push_back(Isa::baseline);
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
    found.push_back(Isa::avx2);
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
    found.push_back(Isa::avx512);
#else
  found.push_back(Isa::neon);
#endif
  if (found.empty())
    throw std::runtime_error("gsstream-cpu-render needs at least SSE4.2 (x86-64-v2) on this processor.");
  return found;
}

Isa active_isa() {
  int current = selected.load(std::memory_order_relaxed);
  if (current < 0) {
    const char* wanted = std::getenv("GSSTREAM_ISA");
    const Isa isa = wanted && *wanted ? isa_from_name(wanted, "GSSTREAM_ISA") : supported_isas().back();
    current = static_cast<int>(isa);
    selected.store(current, std::memory_order_relaxed);
  }
  return static_cast<Isa>(current);
}

void select_isa(const std::string& name) {
  selected.store(static_cast<int>(isa_from_name(name, "select_isa")), std::memory_order_relaxed);
}

}  // namespace gsstream_cpu
