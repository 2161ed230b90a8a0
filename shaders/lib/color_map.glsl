// Defines: color_of.

uniform sampler2D color_map;  // one row of colours

// 0 is the first colour, 1 the last.
vec3 color_of(float share) {
    float count = float(textureSize(color_map, 0).x);
    return texture(color_map, vec2((clamp(share, 0.0, 1.0) * (count - 1.0) + 0.5) / count, 0.5)).rgb;
}
