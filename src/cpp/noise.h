// Noise in space, the same for the same seed on any machine: what procedural skin, cloth and irises are painted with.
#pragma once
#include <cstddef>
#include <cstdint>
#include <span>

namespace cap4d {

// Gradient noise (Perlin 2002) of points [N, 3] in units of its lattice: values [N] in about [-1, 1], mean 0.
void gradient_noise(std::span<const float> points, std::uint32_t seed, float* values);

// Cellular noise (Worley 1996), one feature point per unit cell: the distance [N] to the nearest one and a number [N] in
// [0, 1) that is that point's own.
void cellular_noise(std::span<const float> points, std::uint32_t seed, float* distances, float* owns);

}  // namespace cap4d
