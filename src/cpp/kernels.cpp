#include "kernels.h"

#include <cstdlib>
#include <stdexcept>
#include <string>
#include <string_view>

#include "unet_layers.h"

#ifdef CAP4D_HAS_X86_VARIANTS
#include <cpuid.h>
#endif

namespace cap4d {

namespace base {
extern const Kernels kKernels;
extern const UnetKernels<Int8> kInt8Kernels;
extern const UnetKernels<Float32> kFloat32Kernels;
}
#ifdef CAP4D_HAS_X86_VARIANTS
namespace v3 {
extern const Kernels kKernels;
extern const UnetKernels<Int8> kInt8Kernels;
extern const UnetKernels<Float32> kFloat32Kernels;
}
namespace v4 {
extern const Kernels kKernels;
extern const UnetKernels<Int8> kInt8Kernels;
extern const UnetKernels<Float32> kFloat32Kernels;
}
namespace avxvnni {
extern const UnetKernels<Int8> kInt8Kernels;
}
namespace vnni {
extern const UnetKernels<Int8> kInt8Kernels;
}
#endif

namespace {

// What CAP4D_ISA asks for, the widest by default.
std::string_view wanted() {
  const char* set = std::getenv("CAP4D_ISA");
  const std::string_view wish = set && *set ? set : "vnni";
  if (wish != "base" && wish != "v3" && wish != "v4" && wish != "vnni")
    throw std::invalid_argument("CAP4D_ISA: expected base|v3|v4|vnni, got " + std::string(wish));
  return wish;
}

const Kernels& choose() {
  [[maybe_unused]] const std::string_view wish = wanted();
#ifdef CAP4D_HAS_X86_VARIANTS
  const bool no_v4 = wish == "base" || wish == "v3", no_v3 = wish == "base";
  __builtin_cpu_init();
  // By feature: GCC 11 does not know the levels by name. What else a level holds came with these.
  const bool v3_runs = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
  const bool v4_runs = v3_runs && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                       __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  if (v4_runs && !no_v4) return v4::kKernels;
  if (v3_runs && !no_v3) return v3::kKernels;
#endif
  return base::kKernels;
}

#ifdef CAP4D_HAS_X86_VARIANTS
// The 256-bit VNNI of processors without AVX-512. Clang's __builtin_cpu_supports does not know it.
bool has_avxvnni() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  return __get_cpuid_count(7, 1, &a, &b, &c, &d) && (a >> 4 & 1);
}
#endif

const UnetKernels<Int8>& choose_int8() {
#ifdef CAP4D_HAS_X86_VARIANTS
  const std::string_view level = kernels().isa;
  const bool vnni = wanted() == "vnni";
  if (level == "v4") return vnni && __builtin_cpu_supports("avx512vnni") ? vnni::kInt8Kernels : v4::kInt8Kernels;
  if (level == "v3") return vnni && has_avxvnni() ? avxvnni::kInt8Kernels : v3::kInt8Kernels;
#endif
  return base::kInt8Kernels;
}

const UnetKernels<Float32>& choose_float32() {
#ifdef CAP4D_HAS_X86_VARIANTS
  const std::string_view level = kernels().isa;
  if (level == "v4") return v4::kFloat32Kernels;
  if (level == "v3") return v3::kFloat32Kernels;
#endif
  return base::kFloat32Kernels;
}

}  // namespace

const Kernels& kernels() {
  static const Kernels& chosen = choose();
  return chosen;
}

template <>
const UnetKernels<Int8>& unet_kernels() {
  static const UnetKernels<Int8>& chosen = choose_int8();
  return chosen;
}

template <>
const UnetKernels<Float32>& unet_kernels() {
  static const UnetKernels<Float32>& chosen = choose_float32();
  return chosen;
}

}  // namespace cap4d
