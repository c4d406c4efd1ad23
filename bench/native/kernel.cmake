# headbench_kernel(NAME name FOLDER folder [THREADS] SOURCES file...)
#
# Build folder/csrc/<file>... as the Python module headbench.<folder>.<name>. Of them variants.cpp is compiled once per
# instruction set and chosen when run (instruction_sets.h); everything else stays at the platform's baseline. No
# multiply-add is formed that the source does not ask for: passes that must agree, and variants, compute the same numbers.
# THREADS adds what parallel.h needs.
set(HEADBENCH_NATIVE ${CMAKE_CURRENT_LIST_DIR})

function(headbench_kernel)
  cmake_parse_arguments(KERNEL "THREADS" "NAME;FOLDER" "SOURCES" ${ARGN})
  string(REPLACE "/" "_" target ${KERNEL_FOLDER}${KERNEL_NAME})
  set(folder ${PROJECT_SOURCE_DIR}/${KERNEL_FOLDER}/csrc)
  list(TRANSFORM KERNEL_SOURCES PREPEND ${folder}/)
  nanobind_add_module(${target} NB_STATIC NOMINSIZE ${KERNEL_SOURCES})
  set_target_properties(${target} PROPERTIES OUTPUT_NAME ${KERNEL_NAME}
    LIBRARY_OUTPUT_DIRECTORY ${CMAKE_CURRENT_BINARY_DIR}/${KERNEL_FOLDER})
  target_include_directories(${target} PRIVATE ${PROJECT_SOURCE_DIR})
  target_compile_options(${target} PRIVATE
    # Vectors are handed over by inlined functions alone: how others would pass them does not matter.
    -ffp-contract=off -fno-math-errno -fno-trapping-math -Wall -Wextra -Wno-psabi)
  if(KERNEL_THREADS)
    target_sources(${target} PRIVATE ${HEADBENCH_NATIVE}/thread_pool.cpp ${HEADBENCH_NATIVE}/workspace.cpp)
    target_link_libraries(${target} PRIVATE Threads::Threads)
  endif()

  # -O3 makes networks half as fast again, at a third more time to compile; portable code runs only on processors without AVX2.
  set(options_portable -fpeel-loops)
  set(options_neon -O3)
  set(options_avx2 -O3 -mavx2 -mfma)
  # GCC's own header warns of a register it leaves undefined on purpose (GCC bug 105593).
  set(options_avx512 -O3 -mavx2 -mfma -mavx512f -mavx512dq -mavx512bw -mavx512vl -Wno-uninitialized
    -Wno-maybe-uninitialized)
  set(sets portable)
  if(CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64|amd64)$")
    list(APPEND sets avx2)
    target_compile_definitions(${target} PRIVATE HEADBENCH_X86)
    if(HEADBENCH_THIS_MACHINE AND EXISTS /proc/cpuinfo)
      file(STRINGS /proc/cpuinfo avx512 REGEX "flags.* avx512vl" LIMIT_COUNT 1)
    endif()
    if(avx512 OR NOT HEADBENCH_THIS_MACHINE)
      list(APPEND sets avx512)
      target_compile_definitions(${target} PRIVATE HEADBENCH_AVX512)
    endif()
  elseif(CMAKE_SYSTEM_PROCESSOR MATCHES "^(aarch64|arm64|ARM64)$")
    list(APPEND sets neon)
    target_compile_definitions(${target} PRIVATE HEADBENCH_NEON)
  endif()
  foreach(set IN LISTS sets)
    set(variant ${CMAKE_CURRENT_BINARY_DIR}/${target}_${set}.cpp)
    file(CONFIGURE OUTPUT ${variant} CONTENT "#include \"${folder}/variants.cpp\"\n")
    set_source_files_properties(${variant} PROPERTIES
      COMPILE_DEFINITIONS "HEADBENCH_ISA=${set};HEADBENCH_ISA_${set}" COMPILE_OPTIONS "${options_${set}}")
    target_sources(${target} PRIVATE ${variant})
  endforeach()
  install(TARGETS ${target} LIBRARY DESTINATION headbench/${KERNEL_FOLDER})
endfunction()
