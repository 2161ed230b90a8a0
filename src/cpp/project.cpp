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
void count_gaussians(const TileJob&, std::uint16_t*);
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

constexpr int kShFloats = 3 * kShMax;  // of one Gaussian with all harmonics: a whole number of 8s, and of 16s

// The first 3 `used` floats of kLanes Gaussians' coefficients; those of the last repeat past `count`. `sh` [kShFloats] holds rubbish
// beyond. Memory is read in order, one Gaussian after the other: 16 rows side by side would be too many streams to foresee.
CAP4D_INLINE void gather_sh(const GaussiansView& g, int used, std::size_t first, int count, FloatV* sh) {
  const std::size_t stored = 3 * static_cast<std::size_t>(g.sh_count), wanted = (3 * static_cast<std::size_t>(used) + 7) / 8 * 8;
  alignas(64) float near[kLanes][kShFloats];
  const float* rows[kLanes];
  for (int l = 0; l < kLanes; ++l) {
    const float* from = g.sh + stored * (first + (l < count ? l : count - 1));
    rows[l] = near[l];
    if (stored == kShFloats) std::memcpy(near[l], from, kShFloats * sizeof(float));
    else std::memcpy(near[l], from, stored * sizeof(float));
  }
  for (std::size_t i = 0; i < wanted; i += 8) {
    load_rows8(rows, sh + i);
    for (const float*& row : rows) row += 8;
  }
}

// Writes `v_sh` [kShFloats], zero beyond what is used, as rows of `out`; in order, as above.
CAP4D_INLINE void scatter_sh(const FloatV* v_sh, const GaussiansView& g, std::size_t first, int count, float* out) {
  const std::size_t stored = 3 * static_cast<std::size_t>(g.sh_count);
  alignas(64) float near[kLanes][kShFloats];
  for (int i = 0; i < kShFloats; i += 16) store_rows16(v_sh + i, &near[0][i], kShFloats, (1u << count) - 1);
  for (int l = 0; l < count; ++l) {
    if (stored == kShFloats) std::memcpy(out + stored * (first + l), near[l], kShFloats * sizeof(float));
    else std::memcpy(out + stored * (first + l), near[l], stored * sizeof(float));
  }
}

// The colour of one Gaussian, the `lane`th of `basis` [k][lane]: 0.5 + sum of basis x coefficients, before the clamp at 0. The fourth
// element is rubbish. Forward this beats turning the coefficients into registers: nothing else needs them.
CAP4D_INLINE Float4 sh_color_at(const float* sh, int count, const float basis[][kLanes], int lane) {
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

// The same of kLanes Gaussians.
CAP4D_INLINE void sh_color(const FloatV* sh, int used, const FloatV* basis, FloatV* color) {
  for (int c = 0; c < 3; ++c) color[c] = splat(0.5f);
  for (int k = 0; k < used; ++k)
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * sh[3 * k + c];
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
  store_rows16(fields, &splats->x, sizeof(Splat) / sizeof(float), drawn);
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
      const Float4 color = sh_color_at(g.sh + 3 * g.sh_count * (first + l), used, basis, l);
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
    store_rows16(frame, frames[first].turn, sizeof(TriangleFrame) / sizeof(float), whole & bits(sound));
    for (std::uint32_t slivers = whole & ~bits(sound); slivers; slivers &= slivers - 1) {
      const std::size_t id = first + __builtin_ctz(slivers);
      frames[id] = triangle_frame(vertices, faces + 3 * id);
    }
  }
}

// What Gaussians of kLanes received, the sum over their tiles in the order these were listed: the fields of SplatGrad as registers.
constexpr int kReceived = 16;
static_assert(sizeof(SplatGrad) == 12 * sizeof(float));

CAP4D_INLINE void gather_received(const PairGrads& pairs, std::size_t first, std::uint32_t drawn, FloatV* received) {
  typedef float Float8 __attribute__((vector_size(32)));
  alignas(64) float rows[kLanes][kReceived];
  for (int l = 0; l < kLanes; ++l) {
    Float8 low{}, high{};
    if (drawn >> l & 1) {
      const PairRun run = pairs.runs[first + l];
      for (std::uint32_t k = run.first; k < run.first + run.count; ++k) {
        Float8 more;
        Float4 rest;
        std::memcpy(&more, &pairs.grads[k].red, sizeof more);
        std::memcpy(&rest, &pairs.grads[k].sxu, sizeof rest);
        low += more;
        high += Float8{rest[0], rest[1]};
      }
    }
    std::memcpy(rows[l], &low, sizeof low);
    std::memcpy(rows[l] + 8, &high, sizeof high);
  }
  const float *low[kLanes], *high[kLanes];
  for (int l = 0; l < kLanes; ++l) low[l] = rows[l], high[l] = rows[l] + 8;
  load_rows8(low, received);
  load_rows8(high, received + 8);
}

// v_sh [kShFloats] and v_basis [kShMax] from v_color, which is already masked by the clamp.
CAP4D_INLINE void sh_color_vjp(const FloatV* sh, int used, const FloatV* basis, const FloatV* v_color, FloatV* v_sh, FloatV* v_basis) {
  for (int k = 0; k < used; ++k) {
    for (int c = 0; c < 3; ++c) v_sh[3 * k + c] = basis[k] * v_color[c];
    v_basis[k] = v_color[0] * sh[3 * k] + v_color[1] * sh[3 * k + 1] + v_color[2] * sh[3 * k + 2];
  }
  for (int i = 3 * used; i < kShFloats; ++i) v_sh[i] = FloatV{};
}

// Rows of kComponents floats from registers, those of `drawn`, and zeros for the others: their lanes may hold anything.
template <int kComponents>
CAP4D_INLINE void scatter(const FloatV* values, MaskV drawn, std::size_t first, int count, float* items) {
  float lanes[kComponents][kLanes];
  for (int c = 0; c < kComponents; ++c) store(lanes[c], keep(drawn, values[c]));
  for (int l = 0; l < count; ++l)
    for (int c = 0; c < kComponents; ++c) items[kComponents * (first + l) + c] = lanes[c][l];
}

void project_bwd(const Camera& camera, const GaussiansView& g, std::size_t begin, std::size_t end, const std::int32_t* radii,
                 const PairGrads& pairs, const GaussianGrads& out) {
  const int used = (g.sh_degree + 1) * (g.sh_degree + 1);
  for (std::size_t first = begin; first < end; first += kLanes) {
    const int count = static_cast<int>(std::min<std::size_t>(kLanes, end - first));
    std::uint32_t which = 0;
    for (int l = 0; l < count; ++l) which |= static_cast<std::uint32_t>(radii[first + l] > 0) << l;
    const MaskV drawn = mask_of(which);
    FloatV received[kReceived];
    gather_received(pairs, first, which, received);
    const Shape3<FloatV> shape = gather_shape(g, first, count);
    FloatV opacity;
    gather<1>(g.opacities, first, count, &opacity);
    const Projection<FloatV> p = project(camera, shape);
    const Footprint<FloatV>& f = p.footprint;
    // d(ln density) = covariance^-1 d . d(mean) + (covariance^-1 d)^T d(covariance) (covariance^-1 d) / 2, and the inverse is diagonal
    // in (dx, u).
    const FloatV v_y = f.inv_uu * received[6];
    const FootprintGrad<FloatV> v = {f.inv_xx * received[5] - f.shear * v_y, v_y, received[3],
                                     0.5f * f.inv_xx * (f.inv_xx * received[7]), 0.5f * f.inv_xx * (f.inv_uu * received[8]),
                                     0.5f * f.inv_uu * (f.inv_uu * received[9])};
    Shape3<FloatV> v_shape = project_vjp(camera, shape, p, v);

    const Direction direction = view_direction(camera, shape.mean);
    FloatV basis[kShMax], sh[kShFloats], color[3], v_color[3], v_basis[kShMax], v_sh[kShFloats], v_unit[3];
    sh_basis(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], basis);
    gather_sh(g, used, first, count, sh);
    sh_color(sh, used, basis, color);
    for (int c = 0; c < 3; ++c) v_color[c] = keep(both(drawn, less(splat(0.0f), color[c])), received[c]);
    sh_color_vjp(sh, used, basis, v_color, v_sh, v_basis);
    for (int i = 0; i < 3 * used; ++i) v_sh[i] = keep(drawn, v_sh[i]);
    scatter_sh(v_sh, g, first, count, out.sh);
    sh_basis_vjp(g.sh_degree, direction.unit[0], direction.unit[1], direction.unit[2], v_basis, v_unit);
    // Where a basis function is 0, its coefficient may be anything that is a number and the colour still sane.
    const MaskV fits = less(absolute(v_unit[0]) + absolute(v_unit[1]) + absolute(v_unit[2]), splat(1e30f));  // false for NaN
    for (int i = 0; i < 3; ++i) v_unit[i] = keep(fits, v_unit[i]);
    const FloatV along = v_unit[0] * direction.unit[0] + v_unit[1] * direction.unit[1] + v_unit[2] * direction.unit[2];
    for (int i = 0; i < 3; ++i)
      v_shape.mean[i] = v_shape.mean[i] + (v_unit[i] - along * direction.unit[i]) * direction.inverse_norm;

    const FloatV v_opacity = received[4] / opacity, v_means2d[2] = {v.x, v.y};
    scatter<3>(v_shape.mean, drawn, first, count, out.means);
    scatter<4>(v_shape.quat, drawn, first, count, out.quats);
    scatter<3>(v_shape.scale, drawn, first, count, out.scales);
    scatter<2>(v_means2d, drawn, first, count, out.means2d);
    scatter<1>(&v_opacity, drawn, first, count, out.opacities);
  }
}

#define CAP4D_NAME2(x) #x
#define CAP4D_NAME(x) CAP4D_NAME2(x)

}  // namespace

const Kernels kKernels = {CAP4D_NAME(CAP4D_ISA), &project_fwd, &project_packed, &triangle_frames, &project_bwd, &rasterize_fwd, &rasterize_rgba8, &count_gaussians, &rasterize_bwd};

}  // namespace cap4d::CAP4D_ISA
