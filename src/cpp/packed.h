// Gaussians prepared for drawing again and again: what never changes is worked out once, laid out in blocks of 16 so that a register
// takes a component of several Gaussians, and colours are kept in half precision, which halves what a frame reads.
#pragma once
#include <cstddef>
#include <cstdint>

#include "gaussians.h"
#include "scratch.h"

namespace cap4d {

inline constexpr std::size_t kPack = 16;  // Gaussians of a block, on every instruction set

struct alignas(64) PackedFloats {
  float lane[kPack];
};
struct alignas(32) PackedHalves {
  std::uint16_t lane[kPack];
};

// The place of a triangle (GaussianAvatars; fact 27): world = turn * local + centre. Without area it is `flat`: `turn` is then no
// rotation times the size, and what rides on it is turned as `upright` says.
struct alignas(64) TriangleFrame {
  float turn[9];    // rotation times size, row major
  float centre[3];  // m
  float size;       // m
  float flat;       // 1 or 0
  float unused[2];
};

// Components of a block, in this order.
enum PackedField { kPackedMean = 0, kPackedRoot = 3, kPackedExponent = 12, kPackedFields = 13 };

struct Packed {
  std::size_t count = 0, faces_count = 0;
  int sh_count = 0;  // coefficients a channel
  Buffer<PackedFloats> shape;    // [blocks][kPackedFields]: mean; root = rotation times scales, row major; log2(opacity)
  Buffer<PackedHalves> sh;       // [blocks][sh_count][3]
  Buffer<std::int32_t> binding;  // [blocks * 16] into faces; null where the Gaussians stand in the world
  Buffer<std::int32_t> faces;    // [faces_count, 3] into the frame's vertices

  bool bound() const { return binding != nullptr; }
  std::size_t bytes() const;
};

// `gaussians`: activated; in triangles' frames where `binding` is given (the indices are checked by the caller). A Gaussian with a
// field that is not finite is never drawn. Colours beyond half precision's range become its largest number.
Packed pack(const GaussiansView& gaussians, const std::int32_t* binding, const std::int32_t* faces, std::size_t faces_count);

}  // namespace cap4d
