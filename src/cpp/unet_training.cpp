// What lies where: images have a border of one pixel, channels innermost and padded (unet_layers.h), one batch item behind the other. Sums
// and gradients of images are dense, [batch][panel][place][panel width]; places come in scan order ("raster"), or, where a doubling wrote
// them, parity by parity: all pixels of even row and even column first.
#include "unet_training.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>

#include "kernels.h"
#include "pages.h"
#include "parallel.h"
#include "unet.h"
#include "unet_layers.h"

namespace cap4d {

namespace base {
extern const TrainingKernels kTrainingKernels;
}
#ifdef CAP4D_HAS_X86_VARIANTS
namespace v3 {
extern const TrainingKernels kTrainingKernels;
}
namespace v4 {
extern const TrainingKernels kTrainingKernels;
}
#endif

const TrainingKernels& training_kernels() {
#ifdef CAP4D_HAS_X86_VARIANTS
  const std::string_view level = kernels().isa;
  if (level == "v4") return v4::kTrainingKernels;
  if (level == "v3") return v3::kTrainingKernels;
#endif
  return base::kTrainingKernels;
}

namespace {

constexpr int kOutputs = 3, kTaps = 16, kBlock = kChannelBlock, kParities = 4;
constexpr std::size_t kChunk = 96;   // places of a piece of a product
constexpr int kChunkedSide = 32;     // from here on a filter's gradient is summed over bands of rows
constexpr int kBandRows = 8;
constexpr float kEpsilon = 1e-5f;    // of InstanceNorm

using Pixels = std::vector<std::uint32_t>;

int padded(int channels) { return (channels + kBlock - 1) / kBlock * kBlock; }
int panel_width(int channels) { return channels % kMaxPanel == 0 ? kMaxPanel : kBlock; }

struct Values {  // cleared
  Pages<float> data;
  std::size_t size = 0;
  Values() = default;
  explicit Values(std::size_t n) : data(make_pages<float>(n)), size(n) { std::fill_n(data.get(), n, 0.0f); }
  float* get() const { return data.get(); }
};

struct Canvas {
  int side = 0, channels = 0;  // channels: padded
  std::size_t plane = 0;       // of one batch item
  Values values;
  Canvas() = default;
  Canvas(int side, int channels, int batch)
      : side(side), channels(channels), plane(static_cast<std::size_t>(side + 2) * (side + 2) * channels), values(batch * plane) {}
  float* item(int b) const { return values.get() + b * plane; }
  std::uint32_t at(int y, int x) const { return (static_cast<std::uint32_t>(y) * (side + 2) + x) * channels; }  // border included
};

// Row and column of each place of a square, parity by parity.
template <class Visit>
void by_parity(int side, const Visit& visit) {
  for (int parity = 0; parity < kParities; ++parity)
    for (int y = parity / 2; y < side; y += 2)
      for (int x = parity % 2; x < side; x += 2) visit(y, x);
}

Pixels raster_pixels(const Canvas& image) {
  Pixels out;
  for (int y = 0; y < image.side; ++y)
    for (int x = 0; x < image.side; ++x) out.push_back(image.at(y + 1, x + 1));
  return out;
}
Pixels parity_pixels(const Canvas& image) {
  Pixels out;
  by_parity(image.side, [&](int y, int x) { out.push_back(image.at(y + 1, x + 1)); });
  return out;
}
Pixels raster_of_parity(int side) {
  Pixels out;
  by_parity(side, [&](int y, int x) { out.push_back(static_cast<std::uint32_t>(y * side + x)); });
  return out;
}
Pixels parity_of_raster(int side) {
  const Pixels raster = raster_of_parity(side);
  Pixels out(raster.size());
  for (std::size_t q = 0; q < raster.size(); ++q) out[raster[q]] = static_cast<std::uint32_t>(q);
  return out;
}

// Sums, activations or gradients of one layer.
struct Sums {
  int panel = 0, panels = 0;
  std::size_t count = 0;
  Values values;
  Sums() = default;
  Sums(int batch, int channels, int panel, std::size_t count)
      : panel(panel), panels(channels / panel), count(count), values(batch * count * channels) {}
  float* at(int b, int k) const { return values.get() + (static_cast<std::size_t>(b) * panels + k) * count * panel; }
};

// A filter [small, big, 4, 4] and the three products it takes part in.
class Filter {
 public:
  // small_half: where the channels of `small` that come after the first half are, if it is two images; else its channels.
  Filter(int small_channels, int small_half, int big_channels, const Canvas& small, const Canvas& big, int small_panel)
      : small_channels_(small_channels), half_(small_half), big_channels_(big_channels), side_(small.side), small_stride_(small.channels),
        big_stride_(big.channels), small_panel_(small_panel), big_panel_(panel_width(big.channels)), small_plane_(small.plane),
        big_plane_(big.plane), halving_(static_cast<std::size_t>(kTaps) * big_channels * small.channels),
        doubling_(static_cast<std::size_t>(kTaps) * small.channels * big.channels) {
    for (int y = 0; y < side_; ++y)
      for (int x = 0; x < side_; ++x) {
        halving_pixels_.push_back(big.at(2 * y, 2 * x));
        inner_.push_back(small.at(y + 1, x + 1));
      }
    for (int parity = 0; parity < kParities; ++parity)
      for (int y = 0; y < side_; ++y)
        for (int x = 0; x < side_; ++x) doubling_pixels_.push_back(small.at(y + parity / 2, x + parity % 2));
    for (int tap = 0; tap < kTaps; ++tap)
      halving_segments_.push_back({big.at(tap / 4, tap % 4), static_cast<std::uint32_t>(big_channels)});
    for (int tap = 0; tap < 4; ++tap)
      doubling_segments_.push_back({small.at(tap / 2, tap % 2), static_cast<std::uint32_t>(small.channels)});
  }

  std::vector<std::size_t> shape() const { return {static_cast<std::size_t>(small_channels_), static_cast<std::size_t>(big_channels_)}; }

  void pack(const float* weight, int threads) {
    parallel_for(big_channels_, 4, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t b = begin; b < end; ++b) pack_halving(weight, static_cast<int>(b));
    });
    parallel_for(small_channels_, 4, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t s = begin; s < end; ++s) pack_doubling(weight, static_cast<int>(s));
    });
  }

  // From a big image to sums over the small one, in scan order.
  void halve(const Canvas& big, const float* init, int batch, int threads, const Sums& out) const {
    const std::size_t pieces = (out.count + kChunk - 1) / kChunk, units = pieces * out.panels * batch;
    parallel_for(units, 1, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t u = begin; u < end; ++u) {
        const std::size_t first = u % pieces * kChunk;
        const int k = static_cast<int>(u / pieces % out.panels), b = static_cast<int>(u / pieces / out.panels);
        const float* weights = halving_.get() + static_cast<std::size_t>(k) * kTaps * big_channels_ * small_panel_;
        unet_kernels<Float32>().dot({big.item(b), &halving_pixels_[first], std::min(kChunk, out.count - first), halving_segments_.data(),
                                     static_cast<int>(halving_segments_.size()), weights, init + k * small_panel_, small_panel_,
                                     out.at(b, k) + first * small_panel_});
      }
    });
  }

  // From a small image to sums over the big one, parity by parity.
  void double_up(const Canvas& small, const float* init, int batch, int threads, const Sums& out) const {
    const std::size_t places = out.count / kParities, pieces = (places + kChunk - 1) / kChunk;
    const std::size_t units = pieces * kParities * out.panels * batch;
    parallel_for(units, 1, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t u = begin; u < end; ++u) {
        const std::size_t first = u % pieces * kChunk, parity = u / pieces % kParities;
        const int k = static_cast<int>(u / pieces / kParities % out.panels), b = static_cast<int>(u / pieces / kParities / out.panels);
        const float* weights = doubling_.get() + (k * kParities + parity) * 4 * small_stride_ * big_panel_;
        unet_kernels<Float32>().dot({small.item(b), &doubling_pixels_[parity * places + first], std::min(kChunk, places - first),
                                     doubling_segments_.data(), static_cast<int>(doubling_segments_.size()), weights, init + k * big_panel_,
                                     big_panel_, out.at(b, k) + (parity * places + first) * big_panel_});
      }
    });
  }

  // The filter's gradient, as torch has it.
  void gradient(const Canvas& big, const Canvas& small, int batch, int threads, float* out) {
    const bool banded = side_ >= kChunkedSide;
    const std::size_t places = static_cast<std::size_t>(side_) * side_, band = banded ? static_cast<std::size_t>(kBandRows) * side_ : places * batch;
    const std::size_t bands = batch * places / band, taps = banded ? kTaps : 1;  // taps of a piece of work
    const std::size_t filter = static_cast<std::size_t>(big_fours()) * small_stride_;
    if (partial_.size != bands * kTaps * filter) partial_ = Values(bands * kTaps * filter);
    if (big_all_.empty())
      for (int b = 0; b < batch; ++b)
        for (std::size_t p = 0; p < places; ++p) {
          big_all_.push_back(static_cast<std::uint32_t>(b * big_plane_ + halving_pixels_[p]));
          small_all_.push_back(static_cast<std::uint32_t>(b * small_plane_ + inner_[p]));
        }
    parallel_for(bands * kTaps / taps, 1, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t u = begin; u < end; ++u)
        for (std::size_t tap = u * taps % kTaps; tap < u * taps % kTaps + taps; ++tap) {
          const std::size_t part = u * taps / kTaps;
          training_kernels().filter({big.values.get() + big.at(static_cast<int>(tap) / 4, static_cast<int>(tap) % 4), small.values.get(),
                                     &big_all_[part * band], &small_all_[part * band], band, big_fours(), small_stride_,
                                     partial_.get() + (part * kTaps + tap) * filter});
        }
    });
    parallel_for(big_channels_, 4, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t b = begin; b < end; ++b) unpack(bands, filter, static_cast<int>(b), out);
    });
  }

 private:
  int big_fours() const { return (big_channels_ + 3) / 4 * 4; }
  int place(int s) const { return s < half_ ? s : padded(half_) + s - half_; }  // of a small channel among the padded ones

  // Visits runs of small channels that lie one after the other in one block: first channel, its place, how many.
  template <class Visit>
  void small_blocks(const Visit& visit) const {
    for (int s = 0; s < small_channels_;) {
      const int end = s < half_ ? std::min(half_, small_channels_) : small_channels_, at = place(s);
      const int n = std::min(kBlock - at % kBlock, end - s);
      visit(s, at, n);
      s += n;
    }
  }

  void pack_halving(const float* weight, int b) {
    small_blocks([&](int s, int at, int n) {
      float* to = halving_.get() + (static_cast<std::size_t>(at / small_panel_) * kTaps * big_channels_ + b) * small_panel_ + at % small_panel_;
      const float* from = weight + (static_cast<std::size_t>(s) * big_channels_ + b) * kTaps;
      const std::size_t row = static_cast<std::size_t>(big_channels_) * kTaps, step = static_cast<std::size_t>(big_channels_) * small_panel_;
      for (int tap = 0; tap < kTaps; ++tap)
        for (int j = 0; j < n; ++j) to[tap * step + j] = from[j * row + tap];
    });
  }

  void pack_doubling(const float* weight, int s) {
    const float* from = weight + static_cast<std::size_t>(s) * big_channels_ * kTaps;
    const std::size_t step = static_cast<std::size_t>(small_stride_) * big_panel_;
    for (int b = 0; b < big_channels_; b += kBlock) {
      const int n = std::min(kBlock, big_channels_ - b);
      float* to = doubling_.get() + static_cast<std::size_t>(b / big_panel_) * kTaps * step + static_cast<std::size_t>(place(s)) * big_panel_ + b % big_panel_;
      for (int ky = 0; ky < 4; ++ky)
        for (int kx = 0; kx < 4; ++kx) {
          const int py = (ky + 1) % 2, px = (kx + 1) % 2, jy = (3 - py - ky) / 2, jx = (3 - px - kx) / 2;  // k = 3 - p - 2 j
          float* line = to + ((2 * py + px) * 4 + 2 * jy + jx) * step;
          for (int j = 0; j < n; ++j) line[j] = from[(b + j) * kTaps + 4 * ky + kx];
        }
    }
  }

  void unpack(std::size_t bands, std::size_t filter, int b, float* out) const {
    small_blocks([&](int s, int at, int n) {
      float block[kTaps][kBlock] = {};
      for (std::size_t part = 0; part < bands; ++part)
        for (int tap = 0; tap < kTaps; ++tap) {
          const float* from = partial_.get() + (part * kTaps + tap) * filter + static_cast<std::size_t>(b) * small_stride_ + at;
          for (int j = 0; j < n; ++j) block[tap][j] += from[j];
        }
      for (int j = 0; j < n; ++j)
        for (int tap = 0; tap < kTaps; ++tap) out[(static_cast<std::size_t>(s + j) * big_channels_ + b) * kTaps + tap] = block[tap][j];
    });
  }

  int small_channels_, half_, big_channels_, side_, small_stride_, big_stride_, small_panel_, big_panel_;
  std::size_t small_plane_, big_plane_;
  Values halving_;   // [small panel][tap][big][panel width]
  Values doubling_;  // [big panel][parity][tap][small][panel width]
  Values partial_;   // [band][tap][big][small]
  Pixels halving_pixels_, doubling_pixels_, inner_, big_all_, small_all_;
  std::vector<Segment> halving_segments_, doubling_segments_;
};

// The innermost and the outermost layer are not normalised.
struct Norm {
  bool present = false;
  Values mean, gain;  // [batch][channels]
};

}  // namespace

struct UnetPass::Impl {
  int size, width, batch, depth;
  Canvas input;
  std::vector<Canvas> leaky, decoder;           // [depth - 1], [depth]: inputs of down 1.. and of up 0..
  std::vector<Canvas> v_down, v_up;             // [depth]: gradients of sums
  std::vector<Filter> down, up;                // [depth]
  std::vector<Sums> down_sums, up_sums;        // [depth]; up 0 has none
  std::vector<Norm> down_norm, up_norm;        // [depth]
  std::vector<Sums> v_decoder, v_leaky;        // gradients of the inputs
  std::vector<Pixels> leaky_raster, decoder_raster, decoder_parity, v_down_raster, v_up_parity, to_raster, to_parity;
  Values zeros, epsilon, ones, scratch, last_weights, bias_parts;
  Pixels last_pixels;
  std::vector<Segment> last_segments;
  Sums last_sums;

  int channels(int l) const { return unet_channels(width, l); }
  int side(int l) const { return size >> (l + 1); }  // of down l's output

  Impl(int size_, int width_, int batch_, const float* encoding, int encoded)
      : size(size_), width(width_), batch(batch_), depth(unet_depth(size_)), input(size_, padded(kOutputs + encoded), batch_) {
    const Pixels pixels = raster_pixels(input);
    const std::size_t plane = static_cast<std::size_t>(size) * size;
    for (int b = 0; b < batch; ++b)
      for (std::size_t p = 0; p < plane; ++p)
        for (int c = 0; c < encoded; ++c) input.item(b)[pixels[p] + kOutputs + c] = encoding[c * plane + p];
    for (int l = 0; l < depth; ++l) {
      const int wide = padded(channels(l)), s = side(l);
      if (l < depth - 1) leaky.emplace_back(s, wide, batch);
      decoder.emplace_back(s, (l < depth - 1 ? 2 : 1) * wide, batch);
      v_down.emplace_back(s, wide, batch);
      v_up.emplace_back(2 * s, padded(l ? channels(l - 1) : kOutputs), batch);
    }
    for (int l = 0; l < depth; ++l) add_layer(l, kOutputs + encoded);
    make_last();
  }

  void add_layer(int l, int inputs) {
    const int c = channels(l), wide = padded(c), panel = panel_width(wide), s = side(l);
    const bool innermost = l == depth - 1;
    const std::size_t places = static_cast<std::size_t>(s) * s;
    down.emplace_back(c, c, l ? channels(l - 1) : inputs, v_down[l], l ? leaky[l - 1] : input, panel);
    up.emplace_back(innermost ? c : 2 * c, c, l ? channels(l - 1) : kOutputs, decoder[l], v_up[l], panel);
    down_sums.emplace_back(batch, wide, panel, places);
    v_decoder.emplace_back(batch, decoder[l].channels, panel, places);
    const int outside = v_up[l].channels;
    up_sums.push_back(l ? Sums(batch, outside, panel_width(outside), 4 * places) : Sums());
    v_leaky.push_back(innermost ? Sums() : Sums(batch, wide, panel, places));
    down_norm.push_back({l > 0 && !innermost, Values(batch * wide), Values(batch * wide)});
    up_norm.push_back({l > 0, Values(batch * outside), Values(batch * outside)});
    leaky_raster.push_back(innermost ? Pixels() : raster_pixels(leaky[l]));
    decoder_raster.push_back(raster_pixels(decoder[l]));
    decoder_parity.push_back(parity_pixels(decoder[l]));
    v_down_raster.push_back(raster_pixels(v_down[l]));
    v_up_parity.push_back(parity_pixels(v_up[l]));
    to_raster.push_back(raster_of_parity(s)), to_parity.push_back(parity_of_raster(s));
  }

  // Up 0 has three outputs: the four parities of a place are computed together, from its 3 x 3 neighbours.
  void make_last() {
    const Canvas& from = decoder[0];
    const int most = 2 * padded(channels(depth - 1));
    zeros = Values(most), epsilon = Values(most), ones = Values(most);
    std::fill_n(epsilon.get(), most, kEpsilon), std::fill_n(ones.get(), most, 1.0f);
    last_weights = Values(static_cast<std::size_t>(9) * from.channels * kBlock);
    for (int y = 0; y < from.side; ++y)
      for (int x = 0; x < from.side; ++x) last_pixels.push_back(from.at(y, x));
    for (int n = 0; n < 9; ++n) last_segments.push_back({from.at(n / 3, n % 3), static_cast<std::uint32_t>(from.channels)});
    last_sums = Sums(batch, kBlock, kBlock, last_pixels.size());
    std::size_t largest = 0;
    for (int l = 0; l < depth; ++l) largest = std::max({largest, down_sums[l].values.size, up_sums[l].values.size});
    scratch = Values(largest);
    bias_parts = Values(static_cast<std::size_t>(batch) * most);
  }

  void pack_last(const float* weight) {
    const int c = channels(0), wide = padded(c);
    for (int s = 0; s < 2 * c; ++s)
      for (int o = 0; o < kOutputs; ++o)
        for (int tap = 0; tap < kTaps; ++tap) {
          const int ky = tap / 4, kx = tap % 4, py = (ky + 1) % 2, px = (kx + 1) % 2, row = py + (3 - py - ky) / 2, column = px + (3 - px - kx) / 2;
          const std::size_t at = static_cast<std::size_t>(3 * row + column) * decoder[0].channels + (s < c ? s : wide + s - c);
          last_weights.get()[at * kBlock + (2 * py + px) * kOutputs + o] = weight[(static_cast<std::size_t>(s) * kOutputs + o) * kTaps + tap];
        }
  }

  void fill_input(const float* offsets, int threads) {
    const std::size_t plane = static_cast<std::size_t>(size) * size;
    parallel_for(static_cast<std::size_t>(batch) * size, 16, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t row = begin; row < end; ++row) {
        const std::size_t b = row / size, y = row % size;
        for (int x = 0; x < size; ++x)
          for (int c = 0; c < kOutputs; ++c)
            input.item(static_cast<int>(b))[input.at(static_cast<int>(y) + 1, x + 1) + c] = offsets[(b * kOutputs + c) * plane + y * size + x];
      }
    });
  }

  // Norm and activation of every panel. `to` may be null.
  void activate(const Sums& sums, const Norm& norm, const Canvas* to_leaky, const Pixels& leaky_at, const Canvas& to_relu, const Pixels& relu_at,
                int relu_channel, int threads) {
    parallel_for(static_cast<std::size_t>(batch) * sums.panels, 1, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t u = begin; u < end; ++u) {
        const int b = static_cast<int>(u) / sums.panels, k = static_cast<int>(u) % sums.panels, c = k * sums.panel;
        const std::size_t at = u * sums.panel;
        if (norm.present)
          unet_kernels<Float32>().norm({sums.at(b, k), sums.count, sums.panel, epsilon.get(), norm.mean.get() + at, norm.gain.get() + at});
        training_kernels().pass({sums.at(b, k), leaky_at.data(), relu_at.data(), sums.count, sums.panel,
                                 norm.present ? norm.mean.get() + at : zeros.get(), norm.present ? norm.gain.get() + at : ones.get(),
                                 to_leaky ? to_leaky->item(b) + c : nullptr, to_relu.item(b) + relu_channel + c});
      }
    });
  }

  // What the sums get from the images that `activate` made of them.
  void deactivate(const Sums& sums, const Norm& norm, const Sums* v_leaky_sums, const Pixels& leaky_rows, const Sums& v_relu, int relu_panel,
                  const std::uint32_t* relu_rows, const Canvas& to, const Pixels& pixels, float* bias, int count, int threads) {
    parallel_for(static_cast<std::size_t>(batch) * sums.panels, 1, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t u = begin; u < end; ++u) {
        const int b = static_cast<int>(u) / sums.panels, k = static_cast<int>(u) % sums.panels;
        const std::size_t at = u * sums.panel;
        training_kernels().back({sums.at(b, k), v_leaky_sums ? v_leaky_sums->at(b, k) : nullptr, v_relu.at(b, relu_panel + k), leaky_rows.data(),
                                 relu_rows, sums.count, sums.panel, norm.present ? norm.gain.get() + at : nullptr, pixels.data(),
                                 scratch.get() + u * sums.count * sums.panel, to.item(b) + k * sums.panel, bias_parts.get() + at});
      }
    });
    const int wide = sums.panels * sums.panel;
    for (int c = 0; c < count; ++c) {
      bias[c] = 0.0f;  // a norm takes a bias away again
      for (int b = 0; b < batch && !norm.present; ++b) bias[c] += bias_parts.get()[b * wide + c];
    }
  }
};

UnetPass::UnetPass(int size, int width, int batch, const float* encoding, int encoded) {
  check_unet_size(size);
  if (width < 1 || width > kMaxUnetWidth) throw std::invalid_argument("width: expected 1 to " + std::to_string(kMaxUnetWidth));
  if (batch < 1 || batch > 16) throw std::invalid_argument("batch: expected 1 to 16");
  impl_ = std::make_unique<Impl>(size, width, batch, encoding, encoded);
}
UnetPass::~UnetPass() = default;
int UnetPass::size() const { return impl_->size; }
int UnetPass::batch() const { return impl_->batch; }
int UnetPass::depth() const { return impl_->depth; }
std::vector<std::size_t> UnetPass::filter_shape(int layer, bool up) const { return (up ? impl_->up : impl_->down)[layer].shape(); }

void UnetPass::forward(const float* offsets, const LayerTensors* down, const LayerTensors* up, int threads, float* out) {
  Impl& n = *impl_;
  n.fill_input(offsets, threads);
  for (int l = 0; l < n.depth; ++l) n.down[l].pack(down[l].weight, threads), n.up[l].pack(up[l].weight, threads);
  std::vector<float> bias;
  for (int l = 0; l < n.depth; ++l) {
    bias.assign(padded(n.channels(l)), 0.0f);
    if (!n.down_norm[l].present) std::copy_n(down[l].bias, n.channels(l), bias.data());
    n.down[l].halve(l ? n.leaky[l - 1] : n.input, bias.data(), n.batch, threads, n.down_sums[l]);
    n.activate(n.down_sums[l], n.down_norm[l], l < n.depth - 1 ? &n.leaky[l] : nullptr, n.leaky_raster[l], n.decoder[l], n.decoder_raster[l], 0,
               threads);
  }
  for (int l = n.depth - 1; l > 0; --l) {
    n.up[l].double_up(n.decoder[l], n.zeros.get(), n.batch, threads, n.up_sums[l]);
    n.activate(n.up_sums[l], n.up_norm[l], nullptr, n.leaky_raster[l], n.decoder[l - 1], n.decoder_parity[l - 1], padded(n.channels(l - 1)), threads);
  }
  n.pack_last(up[0].weight);
  std::array<float, kBlock> init{};
  for (int i = 0; i < kParities * kOutputs; ++i) init[i] = up[0].bias[i % kOutputs];
  const std::size_t half = n.side(0), size = n.size, plane = size * size;
  parallel_for(n.batch * half, 4, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; ++row) {
      const std::size_t b = row / half, y = row % half;
      float* sums = n.last_sums.at(static_cast<int>(b), 0) + y * half * kBlock;
      unet_kernels<Float32>().dot({n.decoder[0].item(static_cast<int>(b)), &n.last_pixels[y * half], half, n.last_segments.data(),
                                   static_cast<int>(n.last_segments.size()), n.last_weights.get(), init.data(), kBlock, sums});
      for (std::size_t x = 0; x < half; ++x)
        for (int i = 0; i < kParities * kOutputs; ++i) {
          const std::size_t parity = i / kOutputs, c = i % kOutputs;
          out[(b * kOutputs + c) * plane + (2 * y + parity / 2) * size + 2 * x + parity % 2] = sums[x * kBlock + i];
        }
    }
  });
}

void UnetPass::backward(const float* v_out, int threads, const LayerGradients* down, const LayerGradients* up) {
  Impl& n = *impl_;
  const std::size_t size = n.size, plane = size * size;
  for (int c = 0; c < kOutputs; ++c) {
    double sum = 0;
    for (int b = 0; b < n.batch; ++b)
      for (std::size_t p = 0; p < plane; ++p) sum += v_out[(b * kOutputs + c) * plane + p];
    up[0].bias[c] = static_cast<float>(sum);
  }
  parallel_for(n.batch * size, 16, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; ++row) {
      const std::size_t b = row / size, y = row % size;
      for (std::size_t x = 0; x < size; ++x)
        for (int c = 0; c < kOutputs; ++c)
          n.v_up[0].item(static_cast<int>(b))[n.v_up[0].at(static_cast<int>(y) + 1, static_cast<int>(x) + 1) + c] =
              v_out[(b * kOutputs + c) * plane + y * size + x];
    }
  });
  for (int l = 0; l < n.depth; ++l) {
    if (l > 0) {
      const int outside = l - 1;
      n.deactivate(n.up_sums[l], n.up_norm[l], nullptr, n.to_parity[outside], n.v_decoder[outside], n.down_sums[outside].panels,
                   n.to_raster[outside].data(), n.v_up[l], n.v_up_parity[l], up[l].bias, n.channels(outside), threads);
    }
    n.up[l].gradient(n.v_up[l], n.decoder[l], n.batch, threads, up[l].weight);
    n.up[l].halve(n.v_up[l], n.zeros.get(), n.batch, threads, n.v_decoder[l]);
  }
  for (int l = n.depth - 1; l >= 0; --l) {
    const bool innermost = l == n.depth - 1;
    n.deactivate(n.down_sums[l], n.down_norm[l], innermost ? nullptr : &n.v_leaky[l], n.to_parity[l], n.v_decoder[l], 0, nullptr, n.v_down[l],
                 n.v_down_raster[l], down[l].bias, n.channels(l), threads);
    n.down[l].gradient(l ? n.leaky[l - 1] : n.input, n.v_down[l], n.batch, threads, down[l].weight);
    if (l > 0) n.down[l].double_up(n.v_down[l], n.zeros.get(), n.batch, threads, n.v_leaky[l - 1]);
  }
}

}  // namespace cap4d
