// Which triangle each pixel of an image sees, and where on it. Serves UV remeshing, conditioning maps and overlays.
#pragma once
#include <cstdint>
#include <span>

namespace cap4d {

enum class Cull { kNone, kClockwise, kCounterClockwise };  // orientation in the image, y down

// Rasterises triangles whose vertices are given in pixels (pixel centres at .5) with a depth (smaller is nearer).
//   xyz   [V, 3] x px, y px, depth; faces [F, 3] indices < V (checked by the caller)
//   face  [H, W] out: triangle index, or -1; bary [H, W, 3] out: barycentrics, linear in the image
// A triangle with a non-finite vertex, no area or more than float64 holds is skipped. Equal depths: the smaller index wins.
void rasterize_mesh(std::span<const double> xyz, std::span<const std::int32_t> faces, int height, int width, Cull cull,
                    std::int32_t* face, double* bary);

}  // namespace cap4d
