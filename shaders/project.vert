// Poses and projects one Gaussian. Runs over the depth order with transform feedback, so the splats land in the buffer
// already sorted; splat.vert reads them from there, one per instance.
#include "lib/rotation.glsl"
#include "lib/triangle_frame.glsl"
#include "lib/projection.glsl"
#include "lib/spherical_harmonics.glsl"

const float ROUNDING = 0.01;   // px
const float INFINITE = 1e30;   // a determinant that is no number is not smaller

uniform sampler2D grid_vertices;  // vertex i at texel (i % width, i / width), m
uniform mat4 viewmat;             // view from world
uniform vec3 eye;                 // the optical centre in the world, m
uniform vec4 intrinsics;          // fx, fy, cx, cy, px
uniform vec2 image_size;          // px

in vec4 mean_opacity;             // local mean, in units of the triangle's size; opacity after the sigmoid
in vec4 quat;                     // wxyz, local
in vec3 log_scale;                // local, in units of the triangle's size
in uvec3 triangle;                // grid vertices
in vec4 sh[SH_VEC4S];

out vec2 mean2d;                  // px
out vec3 conic;                   // 1/xx, xx/determinant, 1/px^2; xy/xx: see splat.frag
out vec4 color_opacity;
out vec4 axes;                    // half axes of the ellipse alpha = ALPHA_MIN, px; zero: culled

vec3 grid_vertex(uint index) {
    int width = textureSize(grid_vertices, 0).x;
    return texelFetch(grid_vertices, ivec2(int(index) % width, int(index) / width), 0).xyz;
}

// The half axes of the ellipse in which opacity * exp(-d'Sd/2) reaches ALPHA_MIN: eigenvectors of the covariance.
vec4 cutoff_axes(vec3 covariance, float determinant, float opacity) {
    float reach = 2.0 * log(opacity / ALPHA_MIN);  // squared, in standard deviations
    float half_sum = 0.5 * (covariance.x + covariance.z);
    float half_difference = 0.5 * (covariance.x - covariance.z);
    float spread = length(vec2(half_difference, covariance.y));
    // The eigenvector of the larger value, from the better conditioned row.
    vec2 major = half_difference >= 0.0 ? vec2(half_difference + spread, covariance.y)
                                        : vec2(covariance.y, spread - half_difference);
    major = spread > 0.0 ? normalize(major) : vec2(1.0, 0.0);
    float variance = half_sum + spread;
    vec2 half_axes = sqrt(reach * vec2(variance, determinant / variance)) + ROUNDING;
    return vec4(major * half_axes.x, vec2(-major.y, major.x) * half_axes.y);
}

void main() {
    TriangleFrame frame = triangle_frame(grid_vertex(triangle.x), grid_vertex(triangle.y), grid_vertex(triangle.z));
    vec3 mean = frame.rotation * mean_opacity.xyz * frame.size + frame.centre;
    vec3 view = (viewmat * vec4(mean, 1.0)).xyz;
    vec4 local = quat / sqrt(max(dot(quat, quat), SAFE_NORM2));
    mat3 rotation = mat3(viewmat) * quat_to_rotmat(quat_product(normalize(rotmat_to_quat(frame.rotation)), local));
    vec3 scale = exp(log_scale) * frame.size;
    mat3 principal = mat3(rotation[0] * scale.x, rotation[1] * scale.y, rotation[2] * scale.z);
    Footprint footprint = project(view, principal, Pinhole(intrinsics.xy, intrinsics.zw, image_size));

    vec3 covariance = footprint.covariance;
    float opacity = mean_opacity.w;
    bool visible = view.z >= NEAR && opacity > ALPHA_MIN && footprint.determinant < INFINITE;
    mean2d = footprint.mean2d;
    conic = vec3(1.0 / covariance.x, covariance.x / footprint.determinant, covariance.y / covariance.x);
    color_opacity = vec4(eval_sh(sh, normalize(mean - eye)), opacity);
    axes = visible ? cutoff_axes(covariance, footprint.determinant, opacity) : vec4(0.0);
}
