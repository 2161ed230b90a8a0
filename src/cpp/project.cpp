// Gaussians to splats, a register's width at a time, and back. Compiled once per instruction set.
#include "project.h"

#include <algorithm>
#include <cstring>

#include "bind.h"
#include "kernels.h"
#include "sh.h"

namespace cap4d::CAP4D_ISA {

extern const Kernels kKernels;
void rasterize_fwd(const TileJob&, const Image&);
void rasterize_rgba8(const TileJob&, const Image8&);
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

CAP4D_INLINE Direction view_direction(const Camera& camera, const FloatV* mean) {
  Direction d;
  for (int i = 0; i < 3; ++i) d.unit[i] = (mean[i] - camera.pivot[i]) - camera.position[i];
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

// Three standard deviations along the longest axis, px, rounded up.
CAP4D_INLINE IntV radius_of(const Footprint<FloatV>& f) {
  const FloatV middle = 0.5f * (f.xx + f.yy), half = 0.5f * (f.xx - f.yy);
  const FloatV radius = kRadiusSigmas * sqrt(middle + sqrt(half * half + f.xy * f.xy));
  const IntV down = __builtin_convertvector(min(radius, splat(1e9f)), IntV);
  return down + (keep_int(less(__builtin_convertvector(down, FloatV), radius), 1));
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

// What decides whether and where a Gaussian is drawn: its outline's box.
struct Extent {
  FloatV reach, height2, height, width;
  MaskV drawn;
};

// `exponent`: log2(opacity).
CAP4D_INLINE Extent extent_of(const Camera& camera, const Footprint<FloatV>& f, FloatV exponent) {
  Extent e;
  // Slightly outside the exact outline: the pixels themselves decide (2 ln 2 per unit of the base-2 exponent).
  e.reach = 1.38629436f * (exponent - kLog2AlphaMin) + 1e-4f;
  e.height2 = e.reach * f.yy, e.height = sqrt(e.height2), e.width = sqrt(e.reach * f.xx);
  const FloatV finite = (f.x + f.y) * 0.0f + f.inv_xx * 0.0f + f.inv_uu * 0.0f + f.shear * 0.0f + f.det * 0.0f + (e.height2 + e.width) * 0.0f;
  e.drawn = less_equal(splat(0.0f), finite);  // false for NaN
  e.drawn = both(e.drawn, both(less_equal(splat(kNear), f.depth), less_equal(f.depth, splat(kDepthMax))));
  e.drawn = both(e.drawn, both(less(splat(0.0f), f.x + e.width), less(f.x - e.width, splat(static_cast<float>(camera.width)))));
  e.drawn = both(e.drawn, both(less(splat(0.0f), f.y + e.height), less(f.y - e.height, splat(static_cast<float>(camera.height)))));
  return e;
}

CAP4D_INLINE MaskV sane(const FloatV* color) {  // false for NaN
  const FloatV largest = max(max(absolute(color[0]), absolute(color[1])), absolute(color[2]));
  return both(less_equal(largest, splat(kColorMax)), less_equal(splat(0.0f), (color[0] + color[1] + color[2]) * 0.0f));
}

// Writes kLanes Gaussians from `first` on, those of `drawn`: splats, radii (0 for the others) and boxes.
CAP4D_INLINE void put_splats(const Camera& camera, const Footprint<FloatV>& f, const Extent& e, FloatV exponent, const FloatV* color,
                             std::uint32_t drawn, int count, Splat* splats, std::int32_t* radii, TileBox* boxes) {
  const FloatV zero = splat(0.0f);
  const FloatV fields[16] = {f.x, f.y, e.height, f.xy / f.yy, f.shear * e.width, f.det / f.yy * e.reach, 1.0f / e.height2, exponent,
                             f.inv_xx * (-0.5f * kLog2e), f.inv_uu * (-0.5f * kLog2e), f.shear, max(color[0], zero), max(color[1], zero),
                             max(color[2], zero), f.depth, zero};
  store_rows16(fields, &splats->x, drawn);
  const TileRange columns = tile_range(f.x - e.width, f.x + e.width, camera.width), rows = tile_range(f.y - e.height, f.y + e.height, camera.height);
  const IntV radius = radius_of(f);
  for (int l = 0; l < count; ++l) {
    radii[l] = drawn >> l & 1 ? std::max(radius[l], 1) : 0;
    boxes[l] = {static_cast<std::int16_t>(columns.first[l]), static_cast<std::int16_t>(columns.last[l]),
                static_cast<std::int16_t>(rows.first[l]), static_cast<std::int16_t>(rows.last[l])};
  }
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
    const Extent extent = extent_of(camera, f, exponent);
    const FloatV finite = opacity * 0.0f + shape.quat[0] * 0.0f;
    const MaskV drawn = both(extent.drawn, both(less_equal(splat(0.0f), finite), less_equal(splat(kAlphaMin), opacity)));
    const std::uint32_t todo = bits(drawn) & ((1u << count) - 1);
    if (!todo) {
      std::fill_n(radii + first, count, 0);
      continue;
    }
    const Direction direction = view_direction(camera, shape.mean);
    FloatV basis_v[kShMax];
    sh_basis(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], basis_v);
    float basis[kShMax][kLanes], colors[3][kLanes] = {};
    for (int k = 0; k < used; ++k) store(basis[k], basis_v[k]);
    for (std::uint32_t rest = todo; rest; rest &= rest - 1) {
      const int l = __builtin_ctz(rest);
      const Float4 color = sh_color(g.sh + 3 * g.sh_count * (first + l), used, basis, l);
      for (int c = 0; c < 3; ++c) colors[c][l] = color[c];
    }
    const FloatV color[3] = {load(colors[0]), load(colors[1]), load(colors[2])};
    put_splats(camera, f, extent, exponent, color, todo & bits(sane(color)), count, splats + first, radii + first, boxes + (first - begin));
  }
}

// prepared Gaussians ------------------------------------------------------------------------------------------------------------

// Makes rotations times the size of the frames of flat triangles.
void turn_upright(const float* const* rows, FloatV* frame) {
  for (int l = 0; l < kLanes; ++l) {
    TriangleFrame f;
    std::memcpy(&f, rows[l], sizeof f);
    if (f.flat == 0) continue;
    float rotmat[9];
    upright(f, rotmat);
    for (int i = 0; i < 9; ++i) frame[i][l] = rotmat[i] * f.size;
  }
}

// Local mean and root of kLanes Gaussians to the world, through the frames of their triangles.
CAP4D_INLINE void to_world(const TriangleFrame* frames, const std::int32_t* binding, FloatV* mean, FloatV root[9]) {
  const float* rows[kLanes];
  for (int l = 0; l < kLanes; ++l) rows[l] = frames[binding[l]].turn;
  FloatV frame[16];
  load_rows8(rows, frame);
  const float* rest[kLanes];
  for (int l = 0; l < kLanes; ++l) rest[l] = rows[l] + 8;
  load_rows8(rest, frame + 8);
  const FloatV local[3] = {mean[0], mean[1], mean[2]};
  for (int i = 0; i < 3; ++i) {
    const FloatV* turn = frame + 3 * i;
    mean[i] = turn[0] * local[0] + turn[1] * local[1] + turn[2] * local[2] + frame[9 + i];
  }
  if (any(less(splat(0.0f), frame[13]))) [[unlikely]] turn_upright(rows, frame);
  FloatV turned[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) turned[3 * i + j] = frame[3 * i] * root[j] + frame[3 * i + 1] * root[3 + j] + frame[3 * i + 2] * root[6 + j];
  std::memcpy(root, turned, sizeof turned);
}

// 0.5 + sum of basis x coefficients, before the clamp at 0. sh: one block's, from the first of the kLanes on.
CAP4D_INLINE void packed_color(const PackedHalves* sh, int lane, int count, const FloatV* basis, FloatV* color) {
  for (int c = 0; c < 3; ++c) color[c] = splat(0.5f);
  for (int k = 0; k < count; ++k)
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * load_half(sh[3 * k + c].lane + lane);
}

void project_packed(const Camera& camera, const Packed& g, const TriangleFrame* frames, std::size_t begin, std::size_t end, Splat* splats,
                    std::int32_t* radii, TileBox* boxes) {
  const int degree = g.sh_count == 1 ? 0 : g.sh_count == 4 ? 1 : g.sh_count == 9 ? 2 : 3;
  for (std::size_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<std::size_t>(kLanes, end - first)), lane = static_cast<int>(first % kPack);
    const PackedFloats* shape = &g.shape[first / kPack * kPackedFields];
    FloatV mean[3], root[9];
    for (int i = 0; i < 3; ++i) mean[i] = load(shape[kPackedMean + i].lane + lane);
    for (int i = 0; i < 9; ++i) root[i] = load(shape[kPackedRoot + i].lane + lane);
    const FloatV exponent = load(shape[kPackedExponent].lane + lane);
    if (g.bound()) to_world(frames, &g.binding[first], mean, root);
    Projection<FloatV> p;
    FloatV position[2];
    project_mean(camera, mean, p, position);
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j)
        p.m[i][j] = p.jacobian_view[i][0] * root[j] + p.jacobian_view[i][1] * root[3 + j] + p.jacobian_view[i][2] * root[6 + j];
    const Footprint<FloatV> f = footprint(position, p.view[2], p.m);
    const Extent extent = extent_of(camera, f, exponent);
    std::uint32_t todo = bits(both(extent.drawn, less_equal(splat(kLog2AlphaMin), exponent))) & ((1u << count) - 1);
    if (!todo) {
      std::fill_n(radii + first, count, 0);
      continue;
    }
    const Direction direction = view_direction(camera, mean);
    FloatV basis[kShMax], color[3];
    sh_basis(degree, direction.unit[0], direction.unit[1], direction.unit[2], basis);
    packed_color(&g.sh[first / kPack * 3 * g.sh_count], lane, g.sh_count, basis, color);
    put_splats(camera, f, extent, exponent, color, todo, count, splats + first, radii + first, boxes + (first - begin));
  }
}

CAP4D_INLINE void cross(const FloatV* a, const FloatV* b, FloatV* out) {
  for (int i = 0; i < 3; ++i) out[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}
CAP4D_INLINE FloatV dot(const FloatV* a, const FloatV* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
CAP4D_INLINE void safe_normalize(FloatV* v) {
  const FloatV inverse = 1.0f / sqrt(max(dot(v, v), splat(kSafeNorm2)));
  for (int i = 0; i < 3; ++i) v[i] = v[i] * inverse;
}

// A triangle lower than this part of its side is a sliver, whose normal float32 cannot tell.
constexpr float kSliver = 1e-2f;

void triangle_frames(const float* vertices, const std::int32_t* faces, std::size_t begin, std::size_t end, TriangleFrame* frames) {
  for (std::size_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<std::size_t>(kLanes, end - first));
    float lanes[9][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const std::int32_t* face = faces + 3 * (first + (l < count ? l : count - 1));
      for (int corner = 0; corner < 3; ++corner)
        for (int i = 0; i < 3; ++i) lanes[3 * corner + i][l] = vertices[3 * face[corner] + i];
    }
    FloatV edge[3], side[3], a0[3], a1[3], a2[3], frame[16] = {};
    for (int i = 0; i < 3; ++i) {
      const FloatV v0 = load(lanes[i]), v1 = load(lanes[3 + i]), v2 = load(lanes[6 + i]);
      a0[i] = edge[i] = v1 - v0, side[i] = v2 - v0;
      frame[9 + i] = v0 + (edge[i] + side[i]) * (1.0f / 3.0f);
    }
    safe_normalize(a0);
    cross(a0, side, a1);
    const MaskV sound = less(kSliver * kSliver * dot(side, side), dot(a1, a1));  // false for NaN
    safe_normalize(a1);
    cross(a0, a1, a2);  // -(a1 x a0)
    const FloatV height = dot(a2, side);
    const FloatV size = 0.5f * (sqrt(max(dot(edge, edge), splat(kSafeNorm2))) + max(height, -height));
    for (int i = 0; i < 3; ++i) frame[3 * i] = size * a0[i], frame[3 * i + 1] = size * a1[i], frame[3 * i + 2] = size * a2[i];
    frame[12] = size;
    const std::uint32_t whole = (1u << count) - 1;
    store_rows16(frame, frames[first].turn, whole & bits(sound));
    for (std::uint32_t slivers = whole & ~bits(sound); slivers; slivers &= slivers - 1) {
      const std::size_t id = first + __builtin_ctz(slivers);
      frames[id] = triangle_frame(vertices, faces + 3 * id);
    }
  }
}

// Sum of a Gaussian's per-tile gradients, in the order its tiles were listed.
CAP4D_INLINE SplatGrad total(const PairGrads& pairs, std::size_t id) {
  SplatGrad sum{};
  const PairRun run = pairs.runs[id];
  for (std::uint32_t k = run.first; k < run.first + run.count; ++k) {
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

    const Direction direction = view_direction(camera, shape.mean);
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

const Kernels kKernels = {CAP4D_NAME(CAP4D_ISA), &project_fwd, &project_packed, &triangle_frames, &project_bwd, &rasterize_fwd, &rasterize_rgba8, &rasterize_bwd};

}  // namespace cap4d::CAP4D_ISA
