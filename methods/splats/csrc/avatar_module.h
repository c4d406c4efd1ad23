// The avatars' part of the Python module.
#pragma once

#include <nanobind/nanobind.h>

#include <string>

#include "instruction_sets.h"

namespace headbench {

// Throws std::invalid_argument for a name that is not among `runnable_stages`.
const Stages& stages_by_name(const std::string& name);

void bind_avatar(nanobind::module_& m);

}  // namespace headbench
