// Colours of a textured surface under lights: skin that scatters light a little, eyes and lips that shine. A picture of
// what rasterize_mesh saw; shadows come per vertex. Serves synthetic captures.
#pragma once
#include <cstdint>
#include <span>

namespace cap4d {

inline constexpr int kTextureChannels = 8;  // albedo (3, linear), specular, roughness, scattering, height's slope along u, v

// A mesh posed for one picture. All coordinates in one frame, metres; V vertices, F faces, T texture vertices.
struct LitSurface {
  std::span<const std::int32_t> faces, uv_faces;    // [F, 3]
  std::span<const float> positions, normals, soft;  // [V, 3]; `soft` are smoothed normals, which scattered light sees
  std::span<const float> depths;                    // [V] along the camera's axis
  std::span<const float> open;                      // [V] how much of the sky each vertex sees
  std::span<const float> visible;                   // [V, L] how much of each light
  std::span<const float> uvs;                       // [T, 2] texels of `texture`: column, row; texel centres at .5
};

struct Texture {
  std::span<const float> texels;  // [S, S, kTextureChannels]
  int size;
};

struct Lighting {
  std::span<const float> directions, colors;  // [L, 3] unit vectors to the lights; linear RGB
  float sky[3], ground[3], up[3];             // light without direction, from above and from below
  float eye[3];                               // where the camera is
};

// face [H, W] and bary [H, W, 3] as of rasterize_mesh, perspective-correct. Out: rgb [H, W, 3] linear (zero where nothing is
// seen), depth [H, W] (infinite there).
void light_surface(const LitSurface& surface, const Texture& texture, const Lighting& lighting, std::span<const std::int32_t> face,
                   std::span<const double> bary, float* rgb, float* depth);

}  // namespace cap4d
