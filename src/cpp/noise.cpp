#include "noise.h"

#include <algorithm>
#include <cmath>

namespace cap4d {
namespace {

// A 32-bit finaliser (Wellons' lowbias32) over the lattice point.
std::uint32_t mix(std::uint32_t x) {
  x ^= x >> 16;
  x *= 0x7feb352dU;
  x ^= x >> 15;
  x *= 0x846ca68bU;
  return x ^ (x >> 16);
}

std::uint32_t hash(int x, int y, int z, std::uint32_t seed) {
  return mix(static_cast<std::uint32_t>(x) * 0x9e3779b1U ^ mix(static_cast<std::uint32_t>(y) * 0x85ebca6bU ^ mix(static_cast<std::uint32_t>(z) * 0xc2b2ae35U ^ seed)));
}

float unit(std::uint32_t bits) { return static_cast<float>(bits >> 8) * (1.0f / 16777216.0f); }

// Perlin's twelve directions to the edges of a cube, four of them twice.
float gradient(std::uint32_t h, float x, float y, float z) {
  h &= 15;
  const float u = h < 8 ? x : y, v = h < 4 ? y : (h == 12 || h == 14 ? x : z);
  return ((h & 1) ? -u : u) + ((h & 2) ? -v : v);
}

float fade(float t) { return t * t * t * (t * (t * 6 - 15) + 10); }

float lerp(float a, float b, float t) { return a + t * (b - a); }

// A lattice cell; what is not finite or beyond int counts as the first.
int cell(float x) { return std::abs(x) < 1e9f ? static_cast<int>(std::floor(x)) : 0; }

}  // namespace

void gradient_noise(std::span<const float> points, std::uint32_t seed, float* values) {
  for (std::size_t i = 0; 3 * i < points.size(); ++i) {
    const float* p = &points[3 * i];
    const int x = cell(p[0]), y = cell(p[1]), z = cell(p[2]);
    const float fx = p[0] - x, fy = p[1] - y, fz = p[2] - z;
    const float u = fade(fx), v = fade(fy), w = fade(fz);
    float plane[2];
    for (int k = 0; k < 2; ++k) {
      const auto corner = [&](int a, int b) { return gradient(hash(x + a, y + b, z + k, seed), fx - a, fy - b, fz - k); };
      plane[k] = lerp(lerp(corner(0, 0), corner(1, 0), u), lerp(corner(0, 1), corner(1, 1), u), v);
    }
    values[i] = lerp(plane[0], plane[1], w);
  }
}

void cellular_noise(std::span<const float> points, std::uint32_t seed, float* distances, float* owns) {
  for (std::size_t i = 0; 3 * i < points.size(); ++i) {
    const float* p = &points[3 * i];
    const int x = cell(p[0]), y = cell(p[1]), z = cell(p[2]);
    float nearest = 1e30f;
    std::uint32_t winner = 0;
    for (int c = -1; c <= 1; ++c)
      for (int b = -1; b <= 1; ++b)
        for (int a = -1; a <= 1; ++a) {
          const std::uint32_t h = hash(x + a, y + b, z + c, seed), h1 = mix(h + 1), h2 = mix(h + 2);
          const float dx = x + a + unit(h) - p[0], dy = y + b + unit(h1) - p[1], dz = z + c + unit(h2) - p[2];
          const float d = dx * dx + dy * dy + dz * dz;
          if (d < nearest) nearest = d, winner = h;
        }
    distances[i] = std::sqrt(nearest);
    owns[i] = unit(mix(winner + 3));
  }
}

}  // namespace cap4d
