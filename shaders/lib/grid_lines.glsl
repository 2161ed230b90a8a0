// Defines: px_per_unit, line_cover.
// Maths:   lines at the whole numbers of a coordinate that is linear on a triangle, as wide on the screen everywhere:
//          the distance to the nearest, divided by the coordinate's change from pixel to pixel.

// How much `coordinate` changes in a pixel.
float change_per_px(float coordinate) {
    return max(length(vec2(dFdx(coordinate), dFdy(coordinate))), 1e-9);
}

// Coverage of lines `width` px wide at every multiple of `spacing`.
float line_cover(float coordinate, float change, float spacing, float width) {
    float q = coordinate / spacing;
    float distance_px = abs(fract(q - 0.5) - 0.5) * spacing / change;
    return clamp(0.5 * width + 0.5 - distance_px, 0.0, 1.0);
}
