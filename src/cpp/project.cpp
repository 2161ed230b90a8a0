// Gaussians to splats, a register's width at a time, and back. Compiled once per instruction set.
#include "project.h"

#include <algorithm>

#include "kernels.h"
#include "sh.h"

namespace cap4d::CAP4D_ISA {

extern const Kernels kKernels;
void rasterize_fwd(const TileJob&, const Image&);
void rasterize_bwd(const TileJob&, const Image&, const ImageGrad&, const std::uint32_t*, SplatGrad*);

namespace {

// Lane l of component c of items first, first + 1, ...: an array of structures as registers. Lanes past `count` repeat the last item.
template <int kComponents>
CAP4D_INLINE void gather(const float* items, std::size_t first, int count, FloatV* out) {
  float lanes[kComponents][kLanes];
  for (int l = 0; l < kLanes; ++l) {
    const float* item = items + kComponents * (first + (l < count ? l : count - 1));
    for (int c = 0; c < kComponents; ++c) lanes[c][l] = item[c];
  }
  for (int c = 0; c < kComponents; ++c) out[c] = load(lanes[c]);
}

template <int kComponents>
CAP4D_INLINE void spread(const FloatV* values, float out[kComponents][kLanes]) {
  for (int c = 0; c < kComponents; ++c) store(out[c], values[c]);
}

CAP4D_INLINE Shape3<FloatV> gather_shape(const GaussiansView& g, std::size_t first, int count) {
  Shape3<FloatV> shape;
  gather<3>(g.means, first, count, shape.mean);
  gather<4>(g.quats, first, count, shape.quat);
  gather<3>(g.scales, first, count, shape.scale);
  return shape;
}

struct Direction {
  FloatV unit[3], inverse_norm;
};

CAP4D_INLINE Direction view_direction(const Camera& camera, const Shape3<FloatV>& shape) {
  Direction d;
  for (int i = 0; i < 3; ++i) d.unit[i] = (shape.mean[i] - camera.pivot[i]) - camera.position[i];
  const FloatV norm2 = d.unit[0] * d.unit[0] + d.unit[1] * d.unit[1] + d.unit[2] * d.unit[2];
  d.inverse_norm = 1.0f / sqrt(max(norm2, splat(1e-12f)));
  for (int i = 0; i < 3; ++i) d.unit[i] = d.unit[i] * d.inverse_norm;
  return d;
}

// 0.5 + sum of basis x coefficients, before the clamp at 0. basis [k][lane]. The fourth element is rubbish.
CAP4D_INLINE Float4 sh_color(const float* sh, int count, const float basis[][kLanes], int lane) {
  Float4 even = {0.5f, 0.5f, 0.5f, 0.5f}, odd = {};
  const int last = count - 1;
  int k = 0;
  for (; k + 1 < last; k += 2) {
    even += basis[k][lane] * load4(sh + 3 * k);
    odd += basis[k + 1][lane] * load4(sh + 3 * k + 3);
  }
  for (; k < last; ++k) even += basis[k][lane] * load4(sh + 3 * k);
  return even + odd + basis[last][lane] * Float4{sh[3 * last], sh[3 * last + 1], sh[3 * last + 2], 0.0f};
}

CAP4D_INLINE bool sane(float channel) { return channel <= kColorMax && channel >= -kColorMax; }  // false for NaN

int radius_of(float xx, float xy, float yy) {
  const float middle = 0.5f * (xx + yy), half = 0.5f * (xx - yy);
  const float longest = middle + std::sqrt(half * half + xy * xy);
  return static_cast<int>(std::min(std::ceil(kRadiusSigmas * std::sqrt(longest)), 1e9f));
}

// First and last tile of the pixel centres in [low, high] px, a hair too many rather than one too few.
struct TileRange {
  IntV first, last;
};
CAP4D_INLINE TileRange tile_range(FloatV low, FloatV high, int pixels) {
  const FloatV zero = splat(0.0f), end = splat(static_cast<float>(pixels));
  const FloatV first = min(max(low + 0.499f, zero), end), last = min(max(high + 0.501f, zero), end);
  return {__builtin_convertvector(first, IntV) >> kTileLog2, (__builtin_convertvector(last, IntV) - 1) >> kTileLog2};
}

void project_fwd(const Camera& camera, const GaussiansView& g, std::size_t begin, std::size_t end, Splat* splats, std::int32_t* radii,
                 TileBox* boxes) {
  const int used = (g.sh_degree + 1) * (g.sh_degree + 1);
  for (std::size_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<std::size_t>(kLanes, end - first));
    const Shape3<FloatV> shape = gather_shape(g, first, count);
    FloatV opacity;
    gather<1>(g.opacities, first, count, &opacity);
    const Footprint<FloatV> f = project(camera, shape).footprint;
    const FloatV exponent = log2_positive(max(opacity, splat(kAlphaMin)));
    // Slightly outside the exact outline: the pixels themselves decide (2 ln 2 per unit of the base-2 exponent).
    const FloatV reach = 1.38629436f * (exponent - kLog2AlphaMin) + 1e-4f;
    const FloatV height2 = reach * f.yy, height = sqrt(height2), width = sqrt(reach * f.xx);
    const FloatV slope = f.xy / f.yy;
    const FloatV finite = (f.x + f.y) * 0.0f + f.inv_xx * 0.0f + f.inv_uu * 0.0f + f.shear * 0.0f + f.det * 0.0f +
                          (height2 + width) * 0.0f + opacity * 0.0f + shape.quat[0] * 0.0f;
    MaskV drawn = less_equal(splat(0.0f), finite);  // false for NaN
    drawn = both(drawn, both(less_equal(splat(kNear), f.depth), less_equal(f.depth, splat(kDepthMax))));
    drawn = both(drawn, less_equal(splat(kAlphaMin), opacity));
    drawn = both(drawn, both(less(splat(0.0f), f.x + width), less(f.x - width, splat(static_cast<float>(camera.width)))));
    drawn = both(drawn, both(less(splat(0.0f), f.y + height), less(f.y - height, splat(static_cast<float>(camera.height)))));
    std::uint32_t todo = bits(drawn) & ((1u << count) - 1);
    for (int l = 0; l < count; ++l) radii[first + l] = 0;
    if (!todo) continue;

    const Direction direction = view_direction(camera, shape);
    FloatV basis_v[kShMax];
    sh_basis(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], basis_v);
    float basis[kShMax][kLanes];
    for (int k = 0; k < used; ++k) store(basis[k], basis_v[k]);
    const FloatV fields_v[] = {f.x, f.y, f.inv_xx * (-0.5f * kLog2e), f.inv_uu * (-0.5f * kLog2e), f.shear, exponent, f.depth,
                               height, slope, f.shear * width, f.det / f.yy * reach, 1.0f / height2, f.xx, f.xy, f.yy};
    float fields[15][kLanes];
    spread<15>(fields_v, fields);
    const TileRange columns = tile_range(f.x - width, f.x + width, camera.width), rows = tile_range(f.y - height, f.y + height, camera.height);
    for (; todo; todo &= todo - 1) {
      const int l = __builtin_ctz(todo);
      const std::size_t id = first + l;
      const Float4 color = sh_color(g.sh + 3 * g.sh_count * id, used, basis, l);
      if (!sane(color[0]) || !sane(color[1]) || !sane(color[2])) continue;
      Splat& s = splats[id];
      s.x = fields[0][l], s.y = fields[1][l], s.a = fields[2][l], s.c = fields[3][l], s.shear = fields[4][l], s.log2_opacity = fields[5][l];
      s.red = std::max(color[0], 0.0f), s.green = std::max(color[1], 0.0f), s.blue = std::max(color[2], 0.0f);
      s.depth = fields[6][l], s.half_height = fields[7][l], s.slope = fields[8][l], s.y_rightmost = fields[9][l];
      s.half_width2 = fields[10][l], s.inv_height2 = fields[11][l];
      radii[id] = radius_of(fields[12][l], fields[13][l], fields[14][l]);
      boxes[id - begin] = {static_cast<std::int16_t>(columns.first[l]), static_cast<std::int16_t>(columns.last[l]),
                           static_cast<std::int16_t>(rows.first[l]), static_cast<std::int16_t>(rows.last[l])};
    }
  }
}

// Sum of a Gaussian's per-tile gradients, in the order its tiles were listed.
CAP4D_INLINE SplatGrad total(const PairGrads& pairs, std::size_t id) {
  SplatGrad sum{};
  for (std::uint32_t k = pairs.offsets[id]; k < pairs.offsets[id + 1]; ++k) {
    const SplatGrad& v = pairs.grads[k];
    sum.red += v.red, sum.green += v.green, sum.blue += v.blue, sum.depth += v.depth;
    sum.s += v.s, sum.sx += v.sx, sum.su += v.su, sum.sxx += v.sxx, sum.sxu += v.sxu, sum.suu += v.suu;
  }
  return sum;
}

// Writes v_sh of one Gaussian and its v_basis (per lane); v_color is already masked by the clamp.
CAP4D_INLINE void sh_color_vjp(const float* sh, int used, int stored, const float basis[][kLanes], int lane, Float4 v_color, float* v_sh,
                               float v_basis[][kLanes]) {
  for (int k = 0; k + 1 < used; ++k) {
    const Float4 product = v_color * load4(sh + 3 * k);
    v_basis[k][lane] = product[0] + product[1] + product[2];
    store4(v_sh + 3 * k, basis[k][lane] * v_color);  // the fourth element is overwritten by the next k
  }
  const int last = used - 1;
  float sum = 0;
  for (int c = 0; c < 3; ++c) {
    v_sh[3 * last + c] = basis[last][lane] * v_color[c];
    sum += sh[3 * last + c] * v_color[c];
  }
  v_basis[last][lane] = sum;
  for (int i = 3 * used; i < 3 * stored; ++i) v_sh[i] = 0;
}

template <int kComponents>
CAP4D_INLINE void put(float* items, std::size_t id, const float values[kComponents][kLanes], int lane) {
  for (int c = 0; c < kComponents; ++c) items[kComponents * id + c] = values[c][lane];
}

void project_bwd(const Camera& camera, const GaussiansView& g, std::size_t begin, std::size_t end, const std::int32_t* radii,
                 const PairGrads& pairs, const GaussianGrads& out) {
  const int used = (g.sh_degree + 1) * (g.sh_degree + 1);
  for (std::size_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<std::size_t>(kLanes, end - first));
    float received[10][kLanes] = {};
    for (int l = 0; l < count; ++l) {
      if (radii[first + l] == 0) continue;
      const SplatGrad v = total(pairs, first + l);
      const float values[10] = {v.red, v.green, v.blue, v.depth, v.s, v.sx, v.su, v.sxx, v.sxu, v.suu};
      for (int c = 0; c < 10; ++c) received[c][l] = values[c];
    }
    const Shape3<FloatV> shape = gather_shape(g, first, count);
    FloatV opacity;
    gather<1>(g.opacities, first, count, &opacity);
    const Projection<FloatV> p = project(camera, shape);
    const Footprint<FloatV>& f = p.footprint;
    // d(ln density) = covariance^-1 d . d(mean) + (covariance^-1 d)^T d(covariance) (covariance^-1 d) / 2, and the inverse is diagonal
    // in (dx, u).
    const FloatV v_y = f.inv_uu * load(received[6]);
    const FootprintGrad<FloatV> v = {f.inv_xx * load(received[5]) - f.shear * v_y, v_y, load(received[3]),
                                     0.5f * f.inv_xx * (f.inv_xx * load(received[7])), 0.5f * f.inv_xx * (f.inv_uu * load(received[8])),
                                     0.5f * f.inv_uu * (f.inv_uu * load(received[9]))};
    Shape3<FloatV> v_shape = project_vjp(camera, shape, p, v);

    const Direction direction = view_direction(camera, shape);
    FloatV basis_v[kShMax], v_basis_v[kShMax], v_unit[3];
    sh_basis(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], basis_v);
    float basis[kShMax][kLanes], v_basis[kShMax][kLanes] = {};
    for (int k = 0; k < used; ++k) store(basis[k], basis_v[k]);
    for (int l = 0; l < count; ++l) {
      const std::size_t id = first + l;
      float* v_sh = out.sh + 3 * g.sh_count * id;
      if (radii[id] == 0) {
        std::fill_n(v_sh, 3 * g.sh_count, 0.0f);
        continue;
      }
      const float* sh = g.sh + 3 * g.sh_count * id;
      const Float4 color = sh_color(sh, used, basis, l);
      const Float4 v_color = {color[0] > 0 ? received[0][l] : 0.0f, color[1] > 0 ? received[1][l] : 0.0f, color[2] > 0 ? received[2][l] : 0.0f,
                              0.0f};
      sh_color_vjp(sh, used, g.sh_count, basis, l, v_color, v_sh, v_basis);
    }
    for (int k = 0; k < used; ++k) v_basis_v[k] = load(v_basis[k]);
    sh_basis_vjp(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], v_basis_v, v_unit);
    // Where a basis function is 0, its coefficient may be anything that is a number and the colour still sane.
    const MaskV fits = less(absolute(v_unit[0]) + absolute(v_unit[1]) + absolute(v_unit[2]), splat(1e30f));  // false for NaN
    for (int i = 0; i < 3; ++i) v_unit[i] = keep(fits, v_unit[i]);
    const FloatV along = v_unit[0] * direction.unit[0] + v_unit[1] * direction.unit[1] + v_unit[2] * direction.unit[2];
    for (int i = 0; i < 3; ++i)
      v_shape.mean[i] = v_shape.mean[i] + (v_unit[i] - along * direction.unit[i]) * direction.inverse_norm;

    const FloatV v_opacity_v = load(received[4]) / opacity;
    const FloatV v_means2d_v[2] = {v.x, v.y};
    float v_means[3][kLanes], v_quats[4][kLanes], v_scales[3][kLanes], v_means2d[2][kLanes], v_opacity[1][kLanes];
    spread<3>(v_shape.mean, v_means);
    spread<4>(v_shape.quat, v_quats);
    spread<3>(v_shape.scale, v_scales);
    spread<2>(v_means2d_v, v_means2d);
    spread<1>(&v_opacity_v, v_opacity);
    for (int l = 0; l < count; ++l) {
      const std::size_t id = first + l;
      if (radii[id] == 0) {  // its lanes may hold anything
        std::fill_n(out.means + 3 * id, 3, 0.0f);
        std::fill_n(out.quats + 4 * id, 4, 0.0f);
        std::fill_n(out.scales + 3 * id, 3, 0.0f);
        std::fill_n(out.means2d + 2 * id, 2, 0.0f);
        out.opacities[id] = 0;
        continue;
      }
      put<3>(out.means, id, v_means, l);
      put<4>(out.quats, id, v_quats, l);
      put<3>(out.scales, id, v_scales, l);
      put<2>(out.means2d, id, v_means2d, l);
      put<1>(out.opacities, id, v_opacity, l);
    }
  }
}

#define CAP4D_NAME2(x) #x
#define CAP4D_NAME(x) CAP4D_NAME2(x)

}  // namespace

const Kernels kKernels = {CAP4D_NAME(CAP4D_ISA), &project_fwd, &project_bwd, &rasterize_fwd, &rasterize_bwd};

}  // namespace cap4d::CAP4D_ISA
