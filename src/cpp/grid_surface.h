// The head on the UV grid, posed: blendshapes and linear blend skinning of its vertices, what the deformation network sees of that,
// and its answer added. The same maths as HeadRig's Subject in Python, in one pass over memory.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "scratch.h"

namespace cap4d {

// A joint's rotation less the identity, about its place (fact 7: there is no chain).
struct JointTurn {
  int joint;
  bool late;  // does not show in what the network sees: the neck (fact 20)
  float turn[9], pivot[3];  // row major; m
};

inline constexpr std::size_t kSurfaceChunk = 256;  // vertices whose sums stay in the first-level cache

struct GridSurface {
  std::size_t points, rows, joints;
  int size;                       // of the map, px a side
  Buffer<float> neutral;          // [points, 3] m, rig axes
  Buffer<float> basis;            // [rows, points, 3]: expressions, then pose correctives
  Buffer<bool> moves;             // [rows, chunks of kSurfaceChunk points]: not all zero; `find_moving` fills it in
  Buffer<float> skin_weights;     // [joints, points]
  Buffer<std::int32_t> pixels;    // [points] of the map
  Buffer<std::uint8_t> deformable;  // [points]
  Buffer<float> deform_neutral;   // [points, 3] m, OpenCV axes
};

// Expressions are local: most rows are zero over most of the head, which need not be read.
void find_moving(GridSurface& surface);

// How a frame moves it.
struct SurfaceMotion {
  const float* coefficients;  // [rows]
  const float* late;          // [rows] added to them for what the network does not see
  const std::vector<JointTurn>* turns;
};

// vertices [points, 3]: posed, OpenCV axes. offsets [3, size, size], where not null: what moved beyond `rest` [points, 3] (rig axes) in
// the network's eyes, OpenCV axes; pixels without a vertex are left alone.
void pose_surface(const GridSurface& surface, const SurfaceMotion& motion, const float* rest, int threads, float* vertices, float* offsets);

// Adds to vertices the network's answer [3, size, size] where the surface is deformable, elsewhere, or without one, the neutral
// correction (fact 24).
void add_deformation(const GridSurface& surface, const float* answer, int threads, float* vertices);

}  // namespace cap4d
