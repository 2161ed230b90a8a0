#include "mesh.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace cap4d {
namespace {

struct Point {
  double x, y, z;
};

double edge(const Point& a, const Point& b, double x, double y) { return (b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x); }

bool finite(const Point& p) { return std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z); }

// First and past-the-end pixel whose centre may lie in [lo, hi].
std::pair<int, int> pixel_range(double lo, double hi, int size) {
  const double first = std::clamp(std::ceil(lo - 0.5), 0.0, static_cast<double>(size));
  const double last = std::clamp(std::floor(hi - 0.5) + 1.0, 0.0, static_cast<double>(size));
  return {static_cast<int>(first), static_cast<int>(last)};
}

}  // namespace

void rasterize_mesh(std::span<const double> xyz, std::span<const std::int32_t> faces, int height, int width, Cull cull,
                    std::int32_t* face, double* bary) {
  const std::size_t pixels = static_cast<std::size_t>(height) * width;
  std::vector<double> depth(pixels, std::numeric_limits<double>::infinity());
  std::fill_n(face, pixels, -1);
  std::fill_n(bary, pixels * 3, 0.0);
  const auto at = [&](std::int32_t v) { return Point{xyz[3 * v], xyz[3 * v + 1], xyz[3 * v + 2]}; };
  for (std::size_t f = 0; 3 * f < faces.size(); ++f) {
    const Point a = at(faces[3 * f]), b = at(faces[3 * f + 1]), c = at(faces[3 * f + 2]);
    if (!finite(a) || !finite(b) || !finite(c)) continue;
    const double area = edge(a, b, c.x, c.y);  // positive: clockwise as seen with y down
    if (!std::isfinite(area) || area == 0.0 || (cull == Cull::kClockwise && area > 0) || (cull == Cull::kCounterClockwise && area < 0)) continue;
    const auto [x0, x1] = pixel_range(std::min({a.x, b.x, c.x}), std::max({a.x, b.x, c.x}), width);
    const auto [y0, y1] = pixel_range(std::min({a.y, b.y, c.y}), std::max({a.y, b.y, c.y}), height);
    for (int y = y0; y < y1; ++y) {
      for (int x = x0; x < x1; ++x) {
        const double px = x + 0.5, py = y + 0.5;
        const double u = edge(b, c, px, py) / area, v = edge(c, a, px, py) / area, w = edge(a, b, px, py) / area;
        if (!(u >= 0 && v >= 0 && w >= 0)) continue;  // not a number where an edge function overflowed
        const double z = u * a.z + v * b.z + w * c.z;
        const std::size_t i = static_cast<std::size_t>(y) * width + x;
        if (!(z < depth[i])) continue;
        depth[i] = z;
        face[i] = static_cast<std::int32_t>(f);
        bary[3 * i] = u, bary[3 * i + 1] = v, bary[3 * i + 2] = w;
      }
    }
  }
}

}  // namespace cap4d
