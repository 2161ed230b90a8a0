// One register function per noun; module.cpp calls them in order.
#pragma once
#include <pybind11/pybind11.h>

namespace cap4d {
void register_bind(pybind11::module_& m);
void register_ceilings(pybind11::module_& m);
void register_grid_surface(pybind11::module_& m);
void register_lit_surface(pybind11::module_& m);
void register_mesh(pybind11::module_& m);
void register_render(pybind11::module_& m);
void register_similarity(pybind11::module_& m);
void register_sort(pybind11::module_& m);
void register_splatter(pybind11::module_& m);
void register_strands(pybind11::module_& m);
void register_unet(pybind11::module_& m);
}  // namespace cap4d
