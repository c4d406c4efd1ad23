// The networks' functions for one instruction set; compiled once for each.
#include "bench/native/simd.h"

#include "convolution.h"
#include "perceptron.h"
#include "posing.h"

namespace headbench::HEADBENCH_ISA {

extern const GhaKernels gha_kernels;
const GhaKernels gha_kernels = {HEADBENCH_ISA_NAME, forward_scratch, forward_tile, backward_scratch, backward_tile,
                                convolve_scratch, convolve, normalise, sum_gradients, convolve_backward_scratch,
                                convolve_backward, add, nearest, encode, encode_backward,
                                tanh_of, tanh_backward, colors_scratch, colors, colors_backward, pose, pose_backward};

}  // namespace headbench::HEADBENCH_ISA
