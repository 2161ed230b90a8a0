#include "camera.h"

#include <cmath>

#include "constants.h"

namespace cap4d {

Camera make_camera(const double* viewmat, const double* K, int width, int height) {
  Camera camera{};
  for (int i = 0; i < 3; ++i) {
    const double centre = -(viewmat[i] * viewmat[3] + viewmat[4 + i] * viewmat[7] + viewmat[8 + i] * viewmat[11]);
    camera.pivot[i] = static_cast<float>(kPivotStep * std::round(centre / kPivotStep));
    camera.position[i] = static_cast<float>(centre - camera.pivot[i]);
  }
  for (int i = 0; i < 3; ++i) {
    double moved = viewmat[4 * i + 3];
    for (int j = 0; j < 3; ++j) {
      camera.rotation[i][j] = static_cast<float>(viewmat[4 * i + j]);
      moved += viewmat[4 * i + j] * camera.pivot[j];
    }
    camera.translation[i] = static_cast<float>(moved);
  }
  const double fx = K[0], fy = K[4], cx = K[2], cy = K[5];
  const double margin_x = kJacobianMargin * 0.5 * width / fx, margin_y = kJacobianMargin * 0.5 * height / fy;
  camera.fx = static_cast<float>(fx), camera.fy = static_cast<float>(fy);
  camera.cx = static_cast<float>(cx), camera.cy = static_cast<float>(cy);
  camera.x_min = static_cast<float>(-cx / fx - margin_x), camera.x_max = static_cast<float>((width - cx) / fx + margin_x);
  camera.y_min = static_cast<float>(-cy / fy - margin_y), camera.y_max = static_cast<float>((height - cy) / fy + margin_y);
  camera.width = width, camera.height = height;
  return camera;
}

}  // namespace cap4d
