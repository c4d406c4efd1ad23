#define HEADBENCH_ISA avx2
#define HEADBENCH_ISA_NAME "avx2"
#include "loops.h"
