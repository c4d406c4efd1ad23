#define HEADBENCH_ISA avx512
#define HEADBENCH_ISA_NAME "avx512"
#include "loops.h"
