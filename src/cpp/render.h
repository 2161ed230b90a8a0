// The whole splatting pipeline: project, sort by depth, list per tile, rasterise; and its gradient.
#pragma once
#include <vector>

#include "camera.h"
#include "gaussians.h"
#include "kernels.h"
#include "packed.h"
#include "sort.h"
#include "tiles.h"

namespace cap4d {

// One piece of the first stage.
struct Piece {
  std::vector<std::uint32_t> tiles;  // of its Gaussians that list theirs
  std::uint32_t drawn = 0, first_drawn = 0;
  std::uint64_t pairs = 0, first_pair = 0;
};

// Seconds of the last frame, stage by stage.
struct StageTimes {
  double frames = 0, project = 0, sort = 0, tiles = 0, rasterize = 0;
};

// What a forward pass leaves: for the gradient, and as room for the next pass. Independent of the caller's arrays.
struct Rendered {
  Camera camera;
  std::size_t count = 0, drawn = 0;
  std::uint32_t pairs = 0;
  float background[3] = {0, 0, 0};
  Scratch<std::int32_t> radii;  // [N] 3 standard deviations, px; 0 = not drawn
  Scratch<Splat> splats;        // [N] where drawn
  Scratch<PairRun> runs;        // [N] where drawn
  std::vector<Piece> pieces;
  Scratch<Drawn> order;
  SortSpace<Drawn> sorting;
  TileLists lists;
  StageTimes seconds;

  std::size_t bytes() const;  // of all that is kept
};

enum class Pass { kPlay, kTrain };  // kTrain keeps what the gradient needs

// Raises std::length_error beyond 2^31 tile-Gaussian pairs.
void render_fwd(const Camera& camera, const GaussiansView& gaussians, const float* background, Pass pass, int threads, const Image& image,
                Rendered& rendered);

// Where prepared Gaussians are drawn from. vertices [G, 3] of the mesh that they are bound to, or null.
struct View {
  Camera camera;
  const float* background;  // [3], or null
  const float* vertices;
};

// Prepared Gaussians, drawn with buffers that are kept: after the first frames of a kind nothing is allocated.
class Splatter {
 public:
  explicit Splatter(Packed packed) : packed_(std::move(packed)) {}

  void draw(const View& view, int threads, const Image& image);
  void draw(const View& view, int threads, const Image8& image);

  // counts [H, W] of the last picture drawn: how many Gaussians each pixel takes, hidden ones too.
  void count(int threads, std::uint16_t* counts);

  // order [N]: near to far along the third row of `viewmat` [4, 4]; equal depths keep their order, non-finite ones come last.
  void order(const double* viewmat, const float* vertices, int threads, std::uint32_t* order);

  const Packed& packed() const { return packed_; }
  const Rendered& last() const { return rendered_; }

 private:
  void prepare(const View& view, int threads);
  void place_frames(const float* vertices, int threads);

  Packed packed_;
  Scratch<TriangleFrame> frames_;
  Rendered rendered_;
};

// `image` is the forward pass's output, `gaussians` its input. The same bits for any number of threads.
void render_bwd(const Rendered& rendered, const GaussiansView& gaussians, const Image& image, const ImageGrad& v_image, int threads,
                const GaussianGrads& grads);

}  // namespace cap4d
