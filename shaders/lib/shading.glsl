// Defines: facing, headlight.
// Maths:   a light at the camera on flat triangles, so that a coloured surface keeps its shape.

// The grid's triangles are clockwise where they are seen from outside, with row 0 at the bottom.
bool facing() {
    return !gl_FrontFacing;
}

// `view`: the fragment in the camera, m. 0 at grazing angles, 1 straight on.
float headlight(vec3 view) {
    vec3 normal = cross(dFdx(view), dFdy(view));
    return abs(dot(normal, normalize(view))) / max(length(normal), 1e-20);
}
