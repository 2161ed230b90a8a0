// A pinhole camera, OpenCV axes, pixel centres at .5.
#pragma once

namespace cap4d {

struct Camera {
  float rotation[3][3];  // view from world
  // A point near the camera that float32 holds exactly, m; the origin, unless the camera is metres away from that. What is taken
  // from it before it is rotated has lost no digits, where rotation * mean + translation would cancel.
  float pivot[3];
  float translation[3];  // view of the pivot, m
  float position[3];     // the optical centre in the world less the pivot, m
  float fx, fy, cx, cy;  // px
  float x_min, x_max, y_min, y_max;  // where the projection's Jacobian is clamped, in x / z and y / z
  int width, height;     // px
};

// viewmat [4, 4] and K [3, 3], row major. Computed in double: the position is a small difference of large numbers.
Camera make_camera(const double* viewmat, const double* K, int width, int height);

}  // namespace cap4d
