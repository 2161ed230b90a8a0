#include "strands.h"

#include <algorithm>
#include <cmath>

#include "constants.h"

namespace cap4d {
namespace {

constexpr float kSeenThrough = 1.0f / 128.0f;  // a pixel ends when less of what lies behind is seen
constexpr float kWidthMin = 1.0f;  // px; a thinner line is drawn this wide and so much fainter

struct Point {
  float along, across, depth, width, r, g, b, opacity;  // along: the segment's longer axis in the image
};

Point operator+(const Point& a, const Point& b) {
  return {a.along + b.along, a.across + b.across, a.depth + b.depth, a.width + b.width, a.r + b.r, a.g + b.g, a.b + b.b, a.opacity + b.opacity};
}

Point operator*(const Point& a, float s) {
  return {a.along * s, a.across * s, a.depth * s, a.width * s, a.r * s, a.g * s, a.b * s, a.opacity * s};
}

bool drawable(const float* xyz, const StrandImage& image) {
  return xyz[0] > -kStrandMargin && xyz[0] < static_cast<float>(image.width) + kStrandMargin && xyz[1] > -kStrandMargin &&
         xyz[1] < static_cast<float>(image.height) + kStrandMargin && std::isfinite(xyz[2]);
}

Point load(const StrandPoints& points, std::size_t i, bool steep) {
  const float *xyz = &points.xyz[3 * i], *rgba = &points.rgba[4 * i];
  return {xyz[steep], xyz[!steep], xyz[2], points.widths[i], rgba[0], rgba[1], rgba[2], rgba[3]};
}

void blend(const Point& at, float alpha, std::size_t pixel, const StrandImage& image) {
  float& transmittance = image.transmittance[pixel];
  if (transmittance < kSeenThrough) return;
  alpha *= std::clamp((image.depth[pixel] - at.depth) / image.softness + 1.0f, 0.0f, 1.0f);
  if (!(alpha > 0)) return;
  const float weight = transmittance * std::min(alpha, kAlphaMax);
  float* rgb = image.rgb + 3 * pixel;
  rgb[0] += weight * at.r, rgb[1] += weight * at.g, rgb[2] += weight * at.b;
  transmittance -= weight;
}

// One column (or row) of a segment: the pixels within half a width and half a pixel of its centre line.
void draw_column(const Point& at, int column, bool steep, float slant, const StrandImage& image) {
  const float width = std::max(at.width, kWidthMin), reach = 0.5f * width * slant + 0.5f;
  const float opacity = at.opacity * std::min(at.width / kWidthMin, 1.0f);
  const int limit = steep ? image.width : image.height;
  const int first = std::max(0, static_cast<int>(std::ceil(std::max(at.across - reach - 0.5f, -1.0f))));
  const int last = std::min(limit - 1, static_cast<int>(std::floor(std::min(at.across + reach - 0.5f, static_cast<float>(limit)))));
  for (int row = first; row <= last; ++row) {
    const float coverage = std::min(reach - std::abs(static_cast<float>(row) + 0.5f - at.across), 1.0f);
    const std::size_t y = steep ? column : row, x = steep ? row : column;
    if (coverage > 0) blend(at, opacity * coverage, y * image.width + x, image);
  }
}

void draw_segment(const StrandPoints& points, std::size_t i, const StrandImage& image) {
  const float *p = &points.xyz[3 * i], *q = p + 3;
  if (!drawable(p, image) || !drawable(q, image)) return;
  const float dx = q[0] - p[0], dy = q[1] - p[1];
  const bool steep = std::abs(dy) > std::abs(dx);
  Point a = load(points, i, steep), b = load(points, i + 1, steep);
  if (a.along > b.along) std::swap(a, b);
  const float length = b.along - a.along;
  if (!(length > 0)) return;
  const float slant = std::hypot(dx, dy) / length;  // a line's width along the shorter axis, per unit of its width
  const int limit = steep ? image.height : image.width;
  const int first = std::max(0, static_cast<int>(std::ceil(a.along - 0.5f)));
  const int end = std::min(limit, static_cast<int>(std::ceil(b.along - 0.5f)));
  for (int column = first; column < end; ++column) {
    const float t = (static_cast<float>(column) + 0.5f - a.along) / length;
    draw_column(a * (1 - t) + b * t, column, steep, slant, image);
  }
}

}  // namespace

void draw_strands(const StrandPoints& points, std::span<const std::uint32_t> order, const StrandImage& image) {
  for (const std::uint32_t i : order) draw_segment(points, i, image);
}

}  // namespace cap4d
