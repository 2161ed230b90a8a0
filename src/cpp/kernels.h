// The inner loops, compiled once per instruction set (see CMakeLists.txt) and chosen at run time.
#pragma once
#include <cstddef>
#include <cstdint>

#include "camera.h"
#include "gaussians.h"
#include "packed.h"

namespace cap4d {

struct Image {  // caller-owned, row major
  float* rgb;    // [H, W, 3] composited on the background
  float* alpha;  // [H, W]
  float* depth;  // [H, W] expected depth m: sum of w_i z_i over alpha, 0 where alpha is 0
};

enum class Alpha { kOpaque, kStraight, kPremultiplied };  // opaque: composited on the background

struct Image8 {  // caller-owned
  std::uint8_t* rgba;  // [H, W, 4] rounded
  Alpha alpha;
};

struct ImageGrad {
  const float *rgb, *alpha, *depth;  // alpha and depth may be null: no gradient
};

// The tile's share of the work: which Gaussians, near to far, meet the pixels [x0, x0 + kTile) x [y0, y0 + kTile).
struct TileJob {
  const Splat* splats;
  const std::uint32_t* isects;  // [count] indices into splats
  std::size_t count;
  int x0, y0;
  const Camera* camera;
  const float* background;  // [3]
};

// What Gaussian i received in each of its tiles: grads[runs[i].first], runs[i].count of them.
struct PairGrads {
  const SplatGrad* grads;
  const PairRun* runs;  // [N] where drawn
};

struct Kernels {
  const char* isa;
  // Fills splats and radii (3 standard deviations, px; 0 = not drawn) of Gaussians [begin, end), a splat only where drawn,
  // and their boxes [end - begin].
  void (*project_fwd)(const Camera&, const GaussiansView&, std::size_t begin, std::size_t end, Splat* splats, std::int32_t* radii,
                      TileBox* boxes);
  // The same of prepared Gaussians; begin is a multiple of kPack. frames [faces] where they are bound.
  void (*project_packed)(const Camera&, const Packed&, const TriangleFrame* frames, std::size_t begin, std::size_t end, Splat* splats,
                         std::int32_t* radii, TileBox* boxes);
  // The places of triangles [begin, end) of faces [M, 3] into vertices [G, 3].
  void (*triangle_frames)(const float* vertices, const std::int32_t* faces, std::size_t begin, std::size_t end, TriangleFrame* frames);
  void (*project_bwd)(const Camera&, const GaussiansView&, std::size_t begin, std::size_t end, const std::int32_t* radii, const PairGrads&,
                      const GaussianGrads&);
  void (*rasterize_fwd)(const TileJob&, const Image&);
  void (*rasterize_rgba8)(const TileJob&, const Image8&);
  // How many Gaussians each pixel takes, hidden ones too: counts [H, W].
  void (*count_gaussians)(const TileJob&, std::uint16_t* counts);
  // Writes grads[slots[i]] for each i of the job.
  void (*rasterize_bwd)(const TileJob&, const Image&, const ImageGrad&, const std::uint32_t* slots, SplatGrad* grads);
};

// The widest variant this processor runs; CAP4D_ISA=base|v3|v4|vnni in the environment asks for a narrower one.
// Throws std::invalid_argument on any other value.
const Kernels& kernels();

}  // namespace cap4d
