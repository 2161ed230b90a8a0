// cap4d._core: the table of contents. Shapes and ranges are checked by the Python that calls; here only types.
#include "bindings.h"

PYBIND11_MODULE(_core, m) {
  m.doc() = "Fast maths of cap4d, without Python inside.";
  cap4d::register_bind(m);
  cap4d::register_ceilings(m);
  cap4d::register_grid_surface(m);
  cap4d::register_lit_surface(m);
  cap4d::register_mesh(m);
  cap4d::register_render(m);
  cap4d::register_similarity(m);
  cap4d::register_sort(m);
  cap4d::register_splatter(m);
  cap4d::register_strands(m);
  cap4d::register_unet(m);
}
