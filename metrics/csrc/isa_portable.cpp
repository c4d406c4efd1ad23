#define HEADBENCH_ISA portable
#define HEADBENCH_ISA_NAME "portable"
#include "loops.h"
