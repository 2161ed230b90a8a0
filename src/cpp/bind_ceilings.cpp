#include <stdexcept>
#include <string>

#include "bindings.h"
#include "ceilings.h"

namespace py = pybind11;

namespace cap4d {
namespace {

constexpr std::size_t kMaxBytes = std::size_t{1} << 32;

void check(std::size_t bytes, int threads, double seconds) {
  if (bytes < 1 || bytes > kMaxBytes) throw std::invalid_argument("size: expected at most 4 GiB, got " + std::to_string(bytes));
  if (threads < 1 || threads > 256) throw std::invalid_argument("threads: expected 1 to 256, got " + std::to_string(threads));
  if (!(seconds >= 0 && seconds <= 60)) throw std::invalid_argument("seconds: expected 0 to 60");
}

double multiply_add(int threads, double seconds) {
  check(1, threads, seconds);
  py::gil_scoped_release release;
  return multiply_add_rate(threads, seconds);
}

template <double (*kRate)(std::size_t, int, double), std::size_t kBytesPerUnit>
double rate(std::size_t size, int threads, double seconds) {
  check(size > kMaxBytes ? size : size * kBytesPerUnit, threads, seconds);
  py::gil_scoped_release release;
  return kRate(size, threads, seconds);
}

}  // namespace

void register_ceilings(py::module_& m) {
  const auto threads = py::arg("threads");
  const auto seconds = py::arg("seconds") = 0.3;
  m.def("multiply_add_rate", &multiply_add, threads, seconds);
  m.def("copy_rate", &rate<copy_rate, 1>, py::arg("bytes"), threads, seconds);
  m.def("read_rate", &rate<read_rate, 1>, py::arg("bytes"), threads, seconds);
  m.def("sort_pass_rate", &rate<sort_pass_rate, 16>, py::arg("count"), threads, seconds);
}

}  // namespace cap4d
