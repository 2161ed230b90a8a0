// Defines: viewmat, intrinsics, image_size: a pinhole camera, set by `set_camera`.

uniform mat4 viewmat;      // view from world
uniform vec4 intrinsics;   // fx, fy, cx, cy, px
uniform vec2 image_size;   // px
