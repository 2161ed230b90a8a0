#include "packed.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "constants.h"

namespace cap4d {
namespace {

constexpr float kHalfMax = 65504.0f;

// IEEE 754 binary16, to nearest even; |value| <= kHalfMax.
std::uint16_t half_of(float value) {
  const auto bits = std::bit_cast<std::uint32_t>(value);
  const auto sign = static_cast<std::uint16_t>(bits >> 16 & 0x8000);
  const std::uint32_t magnitude = bits & 0x7fffffff;
  if (magnitude < 0x38800000)  // below 2^-14: denormal, in steps of 2^-24; adding 1/2 rounds to them
    return sign | static_cast<std::uint16_t>(std::bit_cast<std::uint32_t>(std::bit_cast<float>(magnitude) + 0.5f) - 0x3f000000);
  return sign | static_cast<std::uint16_t>((magnitude - 0x38000000 + 0xfff + (magnitude >> 13 & 1)) >> 13);
}

bool all_finite(const float* values, std::size_t count) {
  return std::all_of(values, values + count, [](float v) { return std::isfinite(v); });
}

// rotation(quat) diag(scales), row major.
void root_of(const float* quat, const float* scales, float out[9]) {
  double q[4] = {quat[0], quat[1], quat[2], quat[3]};
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const double largest = std::max({std::abs(q[0]), std::abs(q[1]), std::abs(q[2]), std::abs(q[3])});
  for (double& x : q) x = largest > kQuatMin ? x / norm : 0;  // without a direction: no rotation
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double rotmat[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
                            2 * (y * z - w * x),     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
  for (int i = 0; i < 9; ++i) out[i] = static_cast<float>(rotmat[i] * scales[i % 3]);
}

}  // namespace

std::size_t Packed::bytes() const {
  const std::size_t blocks = (count + kPack - 1) / kPack;
  return blocks * (kPackedFields * sizeof(PackedFloats) + 3 * sh_count * sizeof(PackedHalves)) +
         (bound() ? (blocks * kPack + 3 * faces_count) * sizeof(std::int32_t) : 0);
}

Packed pack(const GaussiansView& g, const std::int32_t* binding, const std::int32_t* faces, std::size_t faces_count) {
  const std::size_t blocks = (g.count + kPack - 1) / kPack, sh_floats = 3 * static_cast<std::size_t>(g.sh_count);
  Packed p;
  p.count = g.count, p.sh_count = g.sh_count;
  p.shape = make_buffer<PackedFloats>(blocks * kPackedFields);
  p.sh = make_buffer<PackedHalves>(blocks * sh_floats);
  std::fill_n(p.shape.get(), blocks * kPackedFields, PackedFloats{});
  std::fill_n(p.sh.get(), blocks * sh_floats, PackedHalves{});
  if (binding) {
    p.binding = make_buffer<std::int32_t>(blocks * kPack);
    for (std::size_t i = 0; i < blocks * kPack; ++i) p.binding[i] = i < g.count ? binding[i] : 0;
    p.faces = make_buffer<std::int32_t>(3 * faces_count);
    std::copy_n(faces, 3 * faces_count, p.faces.get());
    p.faces_count = faces_count;
  }
  for (std::size_t i = 0; i < blocks * kPack; ++i) {
    PackedFloats* shape = &p.shape[i / kPack * kPackedFields];
    const std::size_t lane = i % kPack;
    shape[kPackedExponent].lane[lane] = -std::numeric_limits<float>::infinity();  // never drawn
    if (i >= g.count) continue;
    const float *mean = g.means + 3 * i, *quat = g.quats + 4 * i, *scales = g.scales + 3 * i, *sh = g.sh + sh_floats * i;
    if (!all_finite(mean, 3) || !all_finite(quat, 4) || !all_finite(scales, 3) || !all_finite(&g.opacities[i], 1) || !all_finite(sh, sh_floats)) continue;
    float root[9];
    root_of(quat, scales, root);
    for (int k = 0; k < 3; ++k) shape[kPackedMean + k].lane[lane] = mean[k];
    for (int k = 0; k < 9; ++k) shape[kPackedRoot + k].lane[lane] = root[k];
    if (g.opacities[i] > 0) shape[kPackedExponent].lane[lane] = std::log2(g.opacities[i]);
    for (std::size_t k = 0; k < sh_floats; ++k)
      p.sh[i / kPack * sh_floats + k].lane[lane] = half_of(std::clamp(sh[k], -kHalfMax, kHalfMax));
  }
  return p;
}

}  // namespace cap4d
