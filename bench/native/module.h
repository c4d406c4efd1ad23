// What every kernel's Python module needs: arrays of a type and shape, and the check that they fit together.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>

namespace headbench {

template <class T, nanobind::ssize_t... Shape>
using Array = nanobind::ndarray<T, nanobind::shape<Shape...>, nanobind::c_contig, nanobind::device::cpu>;

// Shapes are checked in Python with clear messages; this only keeps memory safe.
inline void require(bool fits) {
  if (!fits) throw std::invalid_argument("arrays do not fit together");
}

// Whether all values are indices below `limit`.
template <class T>
bool below(const T* values, std::size_t count, std::size_t limit) {
  bool all = true;
  for (std::size_t i = 0; i < count; ++i) all &= values[i] >= 0 && static_cast<std::size_t>(values[i]) < limit;
  return all;
}

}  // namespace headbench
