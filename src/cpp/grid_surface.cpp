#include "grid_surface.h"

#include <algorithm>

#include "parallel.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = kSurfaceChunk;

std::size_t chunks_of(const GridSurface& s) { return (s.points + kGrain - 1) / kGrain; }

void add_rows(const GridSurface& s, const float* coefficients, std::size_t first, std::size_t count, float* sums) {
  for (std::size_t k = 0; k < s.rows; ++k) {
    const float c = coefficients[k];
    if (c == 0 || !s.moves[k * chunks_of(s) + first / kGrain]) continue;
    const float* row = &s.basis[3 * (k * s.points + first)];
    for (std::size_t i = 0; i < 3 * count; ++i) sums[i] += c * row[i];
  }
}

void turn_joint(const GridSurface& s, const JointTurn& t, std::size_t first, std::size_t count, const float* unskinned, float* posed) {
  const float* weights = &s.skin_weights[t.joint * s.points + first];
  for (std::size_t i = 0; i < count; ++i) {
    const float w = weights[i];
    if (w == 0) continue;
    const float *at = unskinned + 3 * i, x = at[0] - t.pivot[0], y = at[1] - t.pivot[1], z = at[2] - t.pivot[2];
    for (int c = 0; c < 3; ++c) posed[3 * i + c] += w * (t.turn[3 * c] * x + t.turn[3 * c + 1] * y + t.turn[3 * c + 2] * z);
  }
}

void turn_joints(const GridSurface& s, const std::vector<JointTurn>& turns, bool with_late, std::size_t first, std::size_t count,
                 const float* unskinned, float* posed) {
  std::copy_n(unskinned, 3 * count, posed);
  for (const JointTurn& t : turns)
    if (with_late || !t.late) turn_joint(s, t, first, count, unskinned, posed);
}

void pose_chunk(const GridSurface& s, const SurfaceMotion& m, const float* rest, std::size_t first, std::size_t count, float* vertices, float* offsets) {
  float unskinned[3 * kGrain], posed[3 * kGrain];
  std::copy_n(&s.neutral[3 * first], 3 * count, unskinned);
  add_rows(s, m.coefficients, first, count, unskinned);
  if (offsets) {
    const std::size_t plane = static_cast<std::size_t>(s.size) * s.size;
    turn_joints(s, *m.turns, false, first, count, unskinned, posed);
    for (std::size_t i = 0; i < count; ++i) {
      const float *p = posed + 3 * i, *r = rest + 3 * (first + i);
      float* pixel = offsets + s.pixels[first + i];
      pixel[0] = p[0] - r[0], pixel[plane] = r[1] - p[1], pixel[2 * plane] = r[2] - p[2];
    }
  }
  add_rows(s, m.late, first, count, unskinned);
  turn_joints(s, *m.turns, true, first, count, unskinned, posed);
  for (std::size_t i = 0; i < count; ++i) {
    float* out = vertices + 3 * (first + i);
    out[0] = posed[3 * i], out[1] = -posed[3 * i + 1], out[2] = -posed[3 * i + 2];
  }
}

}  // namespace

void find_moving(GridSurface& s) {
  const std::size_t chunks = chunks_of(s);
  s.moves = make_buffer<bool>(s.rows * chunks);
  for (std::size_t k = 0; k < s.rows; ++k)
    for (std::size_t chunk = 0; chunk < chunks; ++chunk) {
      const float *row = &s.basis[3 * k * s.points], *end = row + 3 * std::min(s.points, (chunk + 1) * kGrain);
      s.moves[k * chunks + chunk] = std::any_of(row + 3 * chunk * kGrain, end, [](float v) { return v != 0; });
    }
}

void pose_surface(const GridSurface& surface, const SurfaceMotion& motion, const float* rest, int threads, float* vertices, float* offsets) {
  parallel_for(surface.points, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    pose_chunk(surface, motion, rest, begin, end - begin, vertices, offsets);
  });
}

void add_deformation(const GridSurface& surface, const float* answer, int threads, float* vertices) {
  const std::size_t plane = static_cast<std::size_t>(surface.size) * surface.size;
  parallel_for(surface.points, 16 * kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      for (int c = 0; c < 3; ++c)
        vertices[3 * i + c] += answer && surface.deformable[i] ? answer[c * plane + surface.pixels[i]] : surface.deform_neutral[3 * i + c];
  });
}

}  // namespace cap4d
