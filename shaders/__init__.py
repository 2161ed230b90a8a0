"""The GLSL of the viewer as package data, installed as cap4d.shaders and read by cap4d.app.shader_source."""
