#include "lit_surface.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace cap4d {
namespace {

using Channels = std::array<float, kTextureChannels>;

struct Vec {
  float x, y, z;
};

Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec operator*(Vec a, float s) { return {a.x * s, a.y * s, a.z * s}; }
float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
Vec unit(Vec a) { return a * (1 / std::sqrt(std::max(dot(a, a), 1e-20f))); }
Vec vec(std::span<const float> values, std::size_t i) { return {values[3 * i], values[3 * i + 1], values[3 * i + 2]}; }
Vec vec(const float* v) { return {v[0], v[1], v[2]}; }

// How far light wanders under the skin, by channel: red is seen farthest round the terminator (Jimenez et al. 2010).
constexpr float kWrap[3] = {0.42f, 0.16f, 0.10f};
constexpr float kSoftNormal[3] = {0.85f, 0.45f, 0.30f};  // share of the smoothed normal
constexpr float kBleed[3] = {0.45f, 0.12f, 0.0f};        // how much a shadow's edge is lifted
constexpr float kF0 = 0.028f;                            // reflectance of skin and of tears, face on
constexpr float kBroadLobe = 0.7f;                       // of the highlight; the rest is narrower by:
constexpr float kNarrow = 0.6f;
constexpr float kBehind = 0.3f;  // share of the sky that the inside of a mouth or a neck sees of what its outside would

Channels sample(const Texture& texture, float u, float v) {
  const float x = std::clamp(u - 0.5f, 0.0f, texture.size - 1.001f), y = std::clamp(v - 0.5f, 0.0f, texture.size - 1.001f);
  const int x0 = static_cast<int>(x), y0 = static_cast<int>(y);
  const float fx = x - x0, fy = y - y0;
  const float* row = &texture.texels[(static_cast<std::size_t>(y0) * texture.size + x0) * kTextureChannels];
  const float* below = row + static_cast<std::size_t>(texture.size) * kTextureChannels;
  Channels out;
  for (int c = 0; c < kTextureChannels; ++c) {
    const float top = row[c] + fx * (row[c + kTextureChannels] - row[c]);
    const float bottom = below[c] + fx * (below[c + kTextureChannels] - below[c]);
    out[c] = top + fy * (bottom - top);
  }
  return out;
}

// Gradients of the two texture coordinates on a triangle, in space: what turns the height's slopes into a surface gradient
// (Mikkelsen 2010). `outwards` is the triangle's normal, not of unit length.
struct Frame {
  Vec u, v, outwards;
};

Frame texture_frame(const LitSurface& s, std::size_t f) {
  const Vec p0 = vec(s.positions, s.faces[3 * f]), e1 = vec(s.positions, s.faces[3 * f + 1]) - p0, e2 = vec(s.positions, s.faces[3 * f + 2]) - p0;
  const float* t0 = &s.uvs[2 * s.uv_faces[3 * f]];
  const float* t1 = &s.uvs[2 * s.uv_faces[3 * f + 1]];
  const float* t2 = &s.uvs[2 * s.uv_faces[3 * f + 2]];
  const Vec n = cross(e1, e2);
  const float area = dot(n, n);
  if (area < 1e-24f) return {{0, 0, 0}, {0, 0, 0}, n};
  const Vec g1 = cross(e2, n) * (1 / area), g2 = cross(n, e1) * (1 / area);  // gradients of the barycentrics of e1, e2
  return {g1 * (t1[0] - t0[0]) + g2 * (t2[0] - t0[0]), g1 * (t1[1] - t0[1]) + g2 * (t2[1] - t0[1]), n};
}

float fresnel(float cosine) {
  const float t = 1 - std::clamp(cosine, 0.0f, 1.0f), t2 = t * t;
  return kF0 + (1 - kF0) * t2 * t2 * t;
}

// Blinn-Phong, normalised, in units of a diffuse white under the same light.
float lobe(float n_dot_h, float roughness) {
  const float alpha = std::max(roughness * roughness, 2e-3f), exponent = 2 / (alpha * alpha) - 2;
  return (exponent + 2) / 8 * std::pow(n_dot_h, exponent);
}

// What shadows swallow comes back in part from bright surroundings (Jimenez et al. 2016, multi-bounce occlusion).
float bounced(float open, float albedo) {
  const float a = 2.0404f * albedo - 0.3324f, b = -4.7951f * albedo + 0.6417f, c = 2.7552f * albedo + 0.6903f;
  return std::max(open, ((open * a + b) * open + c) * open);
}

struct Point {
  Vec position, normal, soft, view;
  float open;
  Channels material;
};

// A surface seen from behind: its normals point away, and what they see of the lights is the other side's.
void turn_over(Point& p, Vec& smooth, std::vector<float>& visible) {
  smooth = smooth * -1, p.soft = p.soft * -1;
  p.open *= kBehind;
  std::fill(visible.begin(), visible.end(), 0.0f);
}

void add_light(const Point& p, Vec l, const float* color, float visible, float* out) {
  const float scatter = p.material[5];
  const float facing = dot(p.normal, l), soft = dot(p.soft, l);
  for (int c = 0; c < 3; ++c) {
    const float wrap = kWrap[c] * scatter, cosine = facing + kSoftNormal[c] * scatter * (soft - facing);
    const float lit = std::clamp((cosine + wrap) / (1 + wrap), 0.0f, 1.0f) / (1 + 0.5f * wrap);
    const float shadow = visible + kBleed[c] * scatter * visible * (1 - visible);
    out[c] += p.material[c] * color[c] * lit * shadow;
  }
  if (facing <= 0 || visible <= 0) return;
  const Vec h = unit(l + p.view);
  const float n_dot_h = std::max(dot(p.normal, h), 0.0f), l_dot_h = std::max(dot(l, h), 0.2f);
  const float shape = kBroadLobe * lobe(n_dot_h, p.material[4]) + (1 - kBroadLobe) * lobe(n_dot_h, p.material[4] * kNarrow);
  const float shine = p.material[3] * shape * fresnel(l_dot_h) * facing / (l_dot_h * l_dot_h) * visible;
  for (int c = 0; c < 3; ++c) out[c] += color[c] * shine;
}

void add_sky(const Point& p, const Lighting& lighting, float* out) {
  const float scatter = p.material[5];
  const Vec soft = p.normal + (p.soft - p.normal) * (0.5f * scatter);
  const float above = 0.5f + 0.5f * dot(soft, vec(lighting.up));
  const float n_dot_v = dot(p.normal, p.view);
  const Vec mirrored = p.normal * (2 * n_dot_v) - p.view;
  const float mirror = std::clamp(0.5f + 0.9f * dot(mirrored, vec(lighting.up)), 0.0f, 1.0f);
  const float gloss = (1 - p.material[4]) * p.material[3] * fresnel(n_dot_v) * p.open * p.open;
  for (int c = 0; c < 3; ++c) {
    const float sky = lighting.sky[c], ground = lighting.ground[c];
    out[c] += p.material[c] * (ground + above * (sky - ground)) * bounced(p.open, p.material[c]);
    out[c] += gloss * (ground + mirror * (1.6f * sky - ground));
  }
}

}  // namespace

void light_surface(const LitSurface& s, const Texture& texture, const Lighting& lighting, std::span<const std::int32_t> face,
                   std::span<const double> bary, float* rgb, float* depth) {
  const std::size_t n_lights = lighting.directions.size() / 3;
  std::vector<float> visible(n_lights);
  std::int32_t framed = -1;
  Frame frame{};
  for (std::size_t i = 0; i < face.size(); ++i) {
    float* out = rgb + 3 * i;
    out[0] = out[1] = out[2] = 0;
    depth[i] = std::numeric_limits<float>::infinity();
    if (face[i] < 0) continue;
    const std::size_t f = face[i];
    if (face[i] != framed) frame = texture_frame(s, f), framed = face[i];
    const float w[3] = {static_cast<float>(bary[3 * i]), static_cast<float>(bary[3 * i + 1]), static_cast<float>(bary[3 * i + 2])};
    Point p{};
    float u = 0, v = 0, z = 0;
    std::fill(visible.begin(), visible.end(), 0.0f);
    for (int k = 0; k < 3; ++k) {
      const std::size_t vertex = s.faces[3 * f + k], corner = s.uv_faces[3 * f + k];
      p.position = p.position + vec(s.positions, vertex) * w[k];
      p.normal = p.normal + vec(s.normals, vertex) * w[k];
      p.soft = p.soft + vec(s.soft, vertex) * w[k];
      p.open += s.open[vertex] * w[k];
      z += s.depths[vertex] * w[k];
      u += s.uvs[2 * corner] * w[k], v += s.uvs[2 * corner + 1] * w[k];
      for (std::size_t l = 0; l < n_lights; ++l) visible[l] += s.visible[vertex * n_lights + l] * w[k];
    }
    p.material = sample(texture, u, v);
    p.view = unit(vec(lighting.eye) - p.position);
    Vec smooth = unit(p.normal);
    p.soft = unit(p.soft);
    if (dot(frame.outwards, p.view) < 0) turn_over(p, smooth, visible);
    Vec slope = frame.u * p.material[6] + frame.v * p.material[7];
    slope = slope - smooth * dot(slope, smooth);
    p.normal = unit(smooth - slope);
    for (std::size_t l = 0; l < n_lights; ++l) add_light(p, vec(lighting.directions, l), &lighting.colors[3 * l], visible[l], out);
    add_sky(p, lighting, out);
    depth[i] = z;
  }
}

}  // namespace cap4d
