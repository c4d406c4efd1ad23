// Eight doubles at once: the compiler's own vectors, which it maps to whatever registers there are. The order in
// which numbers are added is that of the source, so that every instruction set gives the same bits.
#include <cstring>

namespace headbench::metrics {
namespace HEADBENCH_ISA {
namespace {

constexpr int kLanes = 8;

#if defined(__GNUC__) || defined(__clang__)
#define HEADBENCH_METRICS_INLINE inline __attribute__((always_inline))
typedef double Lanes __attribute__((vector_size(kLanes * sizeof(double))));

HEADBENCH_METRICS_INLINE Lanes all(double value) { return Lanes{} + value; }
#else
#define HEADBENCH_METRICS_INLINE inline
struct Lanes {
  double of[kLanes];
  double operator[](int lane) const { return of[lane]; }
};

inline Lanes all(double value) {
  Lanes out;
  for (double& lane : out.of) lane = value;
  return out;
}
#define HEADBENCH_METRICS_OPERATOR(op)                                         \
  inline Lanes operator op(const Lanes& a, const Lanes& b) {                   \
    Lanes out;                                                                 \
    for (int lane = 0; lane < kLanes; ++lane) out.of[lane] = a.of[lane] op b.of[lane]; \
    return out;                                                                \
  }
HEADBENCH_METRICS_OPERATOR(+)
HEADBENCH_METRICS_OPERATOR(-)
HEADBENCH_METRICS_OPERATOR(*)
HEADBENCH_METRICS_OPERATOR(/)
#undef HEADBENCH_METRICS_OPERATOR
#endif

HEADBENCH_METRICS_INLINE Lanes load(const double* from) {
  Lanes out;
  std::memcpy(&out, from, sizeof out);
  return out;
}

HEADBENCH_METRICS_INLINE void store(double* to, const Lanes& value) { std::memcpy(to, &value, sizeof value); }

}  // namespace
}  // namespace HEADBENCH_ISA
}  // namespace headbench::metrics
