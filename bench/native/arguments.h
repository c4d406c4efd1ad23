// Arguments of a Python call as the members of a struct:
//
//   Arguments from(arguments);
//   Size count, triangles;  // what their first array has
//   const Turns in{from(triangles, 3, 3), from(triangles, 3, 3), from(triangles, 3, 3)};
//
// The arguments stay with the caller: pointers into them are valid as long as the tuple.
#pragma once

#include <string>
#include <tuple>

#include "module.h"

namespace headbench {

// A dimension of several arrays. The first array determines it, and the others must have the same.
class Size {
 public:
  operator std::int64_t() const { return value_; }
  bool fits(std::int64_t found) {
    if (value_ < 0) value_ = found;
    return found == value_;
  }

 private:
  std::int64_t value_ = -1;
};

// One argument, which becomes a pointer of the type that it initialises. `Dimensions` are numbers and references to `Size`.
template <class... Dimensions>
class ArrayArgument {
 public:
  ArrayArgument(nanobind::handle value, std::size_t place, bool optional, Dimensions... dimensions)
      : value_(value), place_(place), optional_(optional), dimensions_(dimensions...) {}

  // Throws std::invalid_argument unless it is a contiguous array of this type and shape in host memory.
  template <class T>
  operator T*() const {
    if (optional_ && value_.is_none()) return nullptr;
    nanobind::ndarray<T, nanobind::ndim<sizeof...(Dimensions)>, nanobind::c_contig, nanobind::device::cpu> array;
    int axis = 0;
    const auto fits = [&](auto&... dimensions) { return (fit(dimensions, array.shape(axis++)) && ...); };
    if (!nanobind::try_cast(value_, array, false) || !std::apply(fits, dimensions_))
      throw std::invalid_argument("array " + std::to_string(place_) + " does not fit in type, shape or layout");
    return array.data();
  }

 private:
  static bool fit(std::int64_t expected, std::int64_t found) { return expected == found; }
  static bool fit(Size& expected, std::int64_t found) { return expected.fits(found); }

  nanobind::handle value_;
  std::size_t place_;
  bool optional_;
  std::tuple<Dimensions...> dimensions_;
};

class Arguments {
 public:
  explicit Arguments(const nanobind::tuple& values) : values_(values) {}

  // The next argument: an array of these dimensions.
  template <class... Dimensions>
  ArrayArgument<Dimensions...> operator()(Dimensions&&... dimensions) {
    return {next(), place_, false, dimensions...};
  }
  // The same; null for None.
  template <class... Dimensions>
  ArrayArgument<Dimensions...> optional(Dimensions&&... dimensions) {
    return {next(), place_, true, dimensions...};
  }
  // The next argument: a number.
  template <class T>
  T number() {
    return nanobind::cast<T>(next());
  }

 private:
  nanobind::handle next() {
    if (place_ >= values_.size()) throw std::invalid_argument("arguments are missing");
    return values_[place_++];
  }

  const nanobind::tuple& values_;
  std::size_t place_ = 0;
};

}  // namespace headbench
