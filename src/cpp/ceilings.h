// What this machine can do at best: the rates that no algorithm can exceed. `cap4d bench` measures them beside its times.
#pragma once
#include <cstddef>

namespace cap4d {

// The loops that depend on the instruction set; compiled like the inner loops of splatting (kernels.h) and chosen with them.
struct CeilingKernels {
  std::size_t flops_per_round;
  float (*multiply_add)(std::size_t rounds);               // independent chains of x = x a + b in registers
  float (*read)(const float* values, std::size_t count);  // sum of `count`, a multiple of 1024
};

// Each runs on `threads` threads at once, again and again for about `seconds`, and returns the best rate of one go.
double multiply_add_rate(int threads, double seconds);                   // float32 operations a second, a multiply-add is two
double copy_rate(std::size_t bytes, int threads, double seconds);       // bytes read and written a second; `bytes` is what all threads touch
double read_rate(std::size_t bytes, int threads, double seconds);       // bytes a second
double sort_pass_rate(std::size_t count, int threads, double seconds);  // keys a second through one pass of an 8-bit radix sort

}  // namespace cap4d
