// What training computes of splats beside the rasteriser, as functions of the Python module. Work is divided alike for any
// number of threads, and sums are taken in one order, so that results are equal bit for bit.
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "tasks.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace headbench {
namespace {

// Rotation of an axis-angle vector, and its adjoint; Rodrigues' formula, I + a K + b K^2, row by row.
struct Rodrigues {
  double a, b, by_square_a, by_square_b;  // derivatives by the squared angle
  double cross[9], square[9], rotation[9];

  explicit Rodrigues(const float* v) {
    const double x = v[0], y = v[1], z = v[2], s = x * x + y * y + z * z;
    if (s < 1e-4) {
      a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42));
      b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56));
      by_square_a = -1.0 / 6 + s / 60 - s * s / 1680;
      by_square_b = -1.0 / 24 + s / 360 - s * s / 13440;
    } else {
      const double t = std::sqrt(s), sine = std::sin(t), cosine = std::cos(t);
      a = sine / t;
      b = (1 - cosine) / s;
      by_square_a = 0.5 * (cosine - a) / s;
      by_square_b = 0.5 * (a - 2 * b) / s;
    }
    const double k[9] = {0, -z, y, z, 0, -x, -y, x, 0};
    std::copy(k, k + 9, cross);
    multiply(cross, cross, square);
    for (int i = 0; i < 9; ++i) rotation[i] = (i % 4 == 0) + a * cross[i] + b * square[i];
  }

  static void multiply(const double* l, const double* r, double* out) {
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) out[3 * i + j] = l[3 * i] * r[j] + l[3 * i + 1] * r[3 + j] + l[3 * i + 2] * r[6 + j];
  }

  void backward(const double* by_rotation, const float* v, float* by_v) const {
    double by_a = 0, by_b = 0, transposed[9], left[9], right[9], by_cross[9];
    for (int i = 0; i < 9; ++i) {
      by_a += by_rotation[i] * cross[i];
      by_b += by_rotation[i] * square[i];
      transposed[i] = -cross[i];
    }
    multiply(by_rotation, transposed, left);
    multiply(transposed, by_rotation, right);
    for (int i = 0; i < 9; ++i) by_cross[i] = a * by_rotation[i] + b * (left[i] + right[i]);
    const double by_square = 2 * (by_a * by_square_a + by_b * by_square_b);
    by_v[0] = static_cast<float>(by_cross[7] - by_cross[5] + by_square * v[0]);
    by_v[1] = static_cast<float>(by_cross[2] - by_cross[6] + by_square * v[1]);
    by_v[2] = static_cast<float>(by_cross[3] - by_cross[1] + by_square * v[2]);
  }
};

// The joints of a head: where they are, their rotations along the tree, and the motion each gives to what hangs on it.
struct Skeleton {
  std::size_t joints;
  const std::int64_t* parents;
  std::vector<Rodrigues> own;
  std::vector<double> places, world, positions;  // (J, 3) at rest, (J, 9), (J, 3) posed

  // `rest` is (J, 3), `by_expression` (J, 3, E), `angles` (J, 3).
  Skeleton(std::size_t count, const std::int64_t* tree, const float* rest, const float* by_expression,
           const float* expression, std::size_t expressions, const float* angles)
      : joints(count), parents(tree), places(3 * count), world(9 * count), positions(3 * count) {
    for (std::size_t i = 0; i < 3 * joints; ++i) {
      places[i] = rest[i];
      for (std::size_t e = 0; e < expressions; ++e)
        places[i] += static_cast<double>(by_expression[i * expressions + e]) * expression[e];
    }
    for (std::size_t j = 0; j < joints; ++j) own.emplace_back(angles + 3 * j);
    for (std::size_t j = 0; j < joints; ++j) {
      if (j == 0) {
        std::copy(own[0].rotation, own[0].rotation + 9, world.data());
        std::copy(places.data(), places.data() + 3, positions.data());
        continue;
      }
      const std::size_t p = static_cast<std::size_t>(parents[j]);
      Rodrigues::multiply(&world[9 * p], own[j].rotation, &world[9 * j]);
      for (int row = 0; row < 3; ++row) {
        positions[3 * j + row] = positions[3 * p + row];
        for (int k = 0; k < 3; ++k)
          positions[3 * j + row] += world[9 * p + 3 * row + k] * (places[3 * j + k] - places[3 * p + k]);
      }
    }
  }

  void motions(float* out) const {
    for (std::size_t j = 0; j < joints; ++j)
      for (int row = 0; row < 3; ++row) {
        double offset = positions[3 * j + row];
        for (int k = 0; k < 3; ++k) {
          offset -= world[9 * j + 3 * row + k] * places[3 * j + k];
          out[kMotion * j + 4 * row + k] = static_cast<float>(world[9 * j + 3 * row + k]);
        }
        out[kMotion * j + 4 * row + 3] = static_cast<float>(offset);
      }
  }

  // From gradients by motions (J, 3, 4), and by own rotations (J, 9) on the way; `by_places` is (J, 3).
  void backward(const std::vector<double>& by_motions, std::vector<double> by_own, const float* angles, float* by_angles,
                std::vector<double>& by_places) const {
    std::vector<double> by_world(9 * joints), by_positions(3 * joints);
    by_places.assign(3 * joints, 0.0);
    for (std::size_t j = 0; j < joints; ++j)
      for (int row = 0; row < 3; ++row) {
        const double by_offset = by_motions[kMotion * j + 4 * row + 3];
        by_positions[3 * j + row] = by_offset;
        for (int k = 0; k < 3; ++k) {
          by_world[9 * j + 3 * row + k] = by_motions[kMotion * j + 4 * row + k] - by_offset * places[3 * j + k];
          by_places[3 * j + k] -= world[9 * j + 3 * row + k] * by_offset;
        }
      }
    for (std::size_t j = joints; j-- > 0;) {
      if (j == 0) {
        for (int i = 0; i < 9; ++i) by_own[i] += by_world[i];
        for (int k = 0; k < 3; ++k) by_places[k] += by_positions[k];
      } else {
        const std::size_t p = static_cast<std::size_t>(parents[j]);
        for (int row = 0; row < 3; ++row) {
          const double g = by_positions[3 * j + row];
          by_positions[3 * p + row] += g;
          for (int k = 0; k < 3; ++k) {
            by_world[9 * p + 3 * row + k] += g * (places[3 * j + k] - places[3 * p + k]);
            by_places[3 * j + k] += world[9 * p + 3 * row + k] * g;
            by_places[3 * p + k] -= world[9 * p + 3 * row + k] * g;
          }
          for (int column = 0; column < 3; ++column)
            for (int k = 0; k < 3; ++k) {
              by_world[9 * p + 3 * row + column] += by_world[9 * j + 3 * row + k] * own[j].rotation[3 * column + k];
              by_own[9 * j + 3 * row + column] += world[9 * p + 3 * k + row] * by_world[9 * j + 3 * k + column];
            }
        }
      }
      own[j].backward(&by_own[9 * j], angles + 3 * j, by_angles + 3 * j);
    }
  }
};

constexpr std::int64_t kVerticesPerTask = 512;

template <class Body>
void share_vertices(std::int64_t count, int threads, const Body& body) {
  ThreadPool::instance().run((count + kVerticesPerTask - 1) / kVerticesPerTask, std::max(threads, 1),
                             [&](std::int64_t task, int worker) {
                               const std::int64_t begin = task * kVerticesPerTask;
                               body(begin, std::min(begin + kVerticesPerTask, count), worker);
                             });
}

// A head of one identity as `pose` takes it.
struct Head {
  Array<const float, -1, 3> neutral;           // (V, 3)
  Array<const float, -1, -1, 3> basis;         // (E + 9 (J - 1), V, 3): expressions, pose correctives
  Array<const float, -1, -1> weights;          // (V, J)
  Array<const std::int64_t, -1> parents;       // (J,)
  Array<const float, -1, 3> joints;            // (J, 3)
  Array<const float, -1, 3, -1> by_expression; // (J, 3, E)

  void check(const Array<const float, -1>& expression, const Array<const float, -1, 3>& angles,
             const Array<const float, -1, 3>& lids) const {
    const std::size_t vertices = neutral.shape(0), count = parents.shape(0), expressions = expression.shape(0);
    require(count >= 2 && basis.shape(0) == expressions + 9 * (count - 1) && basis.shape(1) == vertices);
    require(weights.shape(0) == vertices && weights.shape(1) == count && joints.shape(0) == count);
    require(by_expression.shape(0) == count && by_expression.shape(2) == expressions && angles.shape(0) == count);
    require(lids.shape(0) == vertices || lids.shape(0) == 0);
    for (std::size_t j = 1; j < count; ++j)
      require(parents.data()[j] >= 0 && static_cast<std::size_t>(parents.data()[j]) < j);
  }
};

// What is the same in both passes; `coefficients` and `motions` are the memory of its parts.
Posing posing_of(const Head& head, const Skeleton& skeleton, const Array<const float, -1>& expression,
                 const Array<const float, -1, 3>& lids, std::vector<float>& coefficients, std::vector<float>& motions) {
  coefficients.assign(expression.data(), expression.data() + expression.shape(0));
  for (std::size_t j = 1; j < skeleton.joints; ++j)
    for (int i = 0; i < 9; ++i) coefficients.push_back(static_cast<float>(skeleton.own[j].rotation[i] - (i % 4 == 0)));
  motions.resize(kMotion * skeleton.joints);
  skeleton.motions(motions.data());
  Posing in{};
  in.vertices = static_cast<std::int64_t>(head.neutral.shape(0));
  in.joints = static_cast<int>(skeleton.joints);
  in.rows = static_cast<int>(coefficients.size());
  in.neutral = head.neutral.data();
  in.basis = head.basis.data();
  in.coefficients = coefficients.data();
  in.weights = head.weights.data();
  in.motions = motions.data();
  in.lids = lids.shape(0) ? lids.data() : nullptr;
  double rotation[9];
  Rodrigues::multiply(skeleton.own[0].rotation, skeleton.own[1].rotation, rotation);
  std::copy(rotation, rotation + 9, in.lid_rotation);
  return in;
}

void pose(const Array<const float, -1, 3>& neutral, const Array<const float, -1, -1, 3>& basis,
          const Array<const float, -1, -1>& weights, const Array<const std::int64_t, -1>& parents,
          const Array<const float, -1, 3>& joints, const Array<const float, -1, 3, -1>& by_expression,
          const Array<const float, -1>& expression, const Array<const float, -1, 3>& angles,
          const Array<const float, 3>& translation, const Array<const float, -1, 3>& lids,
          const Array<float, -1, 3>& unposed, const Array<float, -1, 3>& posed, const std::string& instruction_set,
          int threads) {
  const Head head{neutral, basis, weights, parents, joints, by_expression};
  head.check(expression, angles, lids);
  require(unposed.shape(0) == neutral.shape(0) && posed.shape(0) == neutral.shape(0));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  const Skeleton skeleton(parents.shape(0), parents.data(), joints.data(), by_expression.data(), expression.data(),
                          expression.shape(0), angles.data());
  std::vector<float> coefficients, motions;
  Posing in = posing_of(head, skeleton, expression, lids, coefficients, motions);
  for (int k = 0; k < 3; ++k) in.translation[k] = translation.data()[k];
  in.unposed = unposed.data();
  in.posed = posed.data();
  share_vertices(in.vertices, threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.pose_vertices(in, begin, end); });
}

void pose_backward(const Array<const float, -1, 3>& neutral, const Array<const float, -1, -1, 3>& basis,
                   const Array<const float, -1, -1>& weights, const Array<const std::int64_t, -1>& parents,
                   const Array<const float, -1, 3>& joints, const Array<const float, -1, 3, -1>& by_expression,
                   const Array<const float, -1>& expression, const Array<const float, -1, 3>& angles,
                   const Array<const float, -1, 3>& lids, const Array<float, -1, 3>& unposed,
                   const Array<const float, -1, 3>& by_posed, const Array<float, -1>& to_expression,
                   const Array<float, -1, 3>& to_angles, const Array<float, 3>& to_translation,
                   const std::string& instruction_set, int threads) {
  const Head head{neutral, basis, weights, parents, joints, by_expression};
  head.check(expression, angles, lids);
  const std::size_t count = parents.shape(0), expressions = expression.shape(0);
  require(unposed.shape(0) == neutral.shape(0) && by_posed.shape(0) == neutral.shape(0));
  require(to_expression.shape(0) == expressions && to_angles.shape(0) == count);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  const Skeleton skeleton(count, parents.data(), joints.data(), by_expression.data(), expression.data(), expressions,
                          angles.data());
  std::vector<float> coefficients, motions;
  Posing in = posing_of(head, skeleton, expression, lids, coefficients, motions);
  in.unposed = unposed.data();
  const std::size_t numbers = static_cast<std::size_t>(in.rows) + kMotion * count + 9 + 3;
  const std::int64_t tasks = (in.vertices + kVerticesPerTask - 1) / kVerticesPerTask;
  std::vector<float> parts(numbers * static_cast<std::size_t>(tasks));
  const Scratch scratch(3 * kVerticesPerTask, threads);
  share_vertices(in.vertices, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    kernels.pose_backward(in, by_posed.data(), begin, end, scratch.of(worker),
                          parts.data() + numbers * static_cast<std::size_t>(begin / kVerticesPerTask));
  });
  std::vector<double> sums(numbers, 0.0);
  for (std::size_t i = 0; i < parts.size(); ++i) sums[i % numbers] += parts[i];
  const double* by_rows = sums.data();
  const double* by_lids = by_rows + in.rows + kMotion * count;
  std::vector<double> by_own(9 * count, 0.0), by_places;
  for (std::size_t i = 9; i < 9 * count; ++i) by_own[i] = by_rows[expressions + i - 9];
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column)
      for (int k = 0; k < 3; ++k) {  // of the lids' rotation, the root's times the neck's
        by_own[3 * row + column] += by_lids[3 * row + k] * skeleton.own[1].rotation[3 * column + k];
        by_own[9 + 3 * row + column] += skeleton.own[0].rotation[3 * k + row] * by_lids[3 * k + column];
      }
  const std::vector<double> by_motions(by_rows + in.rows, by_rows + in.rows + kMotion * count);
  skeleton.backward(by_motions, by_own, angles.data(), to_angles.data(), by_places);
  for (std::size_t e = 0; e < expressions; ++e) {
    double sum = by_rows[e];
    for (std::size_t i = 0; i < 3 * count; ++i) sum += by_places[i] * by_expression.data()[i * expressions + e];
    to_expression.data()[e] = static_cast<float>(sum);
  }
  for (int k = 0; k < 3; ++k) to_translation.data()[k] = static_cast<float>(by_lids[9 + k]);
}

void triangles_backward(const Array<const float, -1, 3>& vertices, const Array<const std::int64_t, -1, 3>& faces,
                        const Array<const float, -1, 3, 3>& by_rotations, const Array<const float, -1, 3>& by_centers,
                        const Array<const float, -1>& by_sizes, const Array<const float, -1, 4>& by_quaternions,
                        const Array<float, -1, 3>& by_vertices, const std::string& instruction_set, int threads) {
  const std::size_t count = faces.shape(0);
  require(by_rotations.shape(0) == count && by_centers.shape(0) == count && by_sizes.shape(0) == count);
  require(by_quaternions.shape(0) == count && by_vertices.shape(0) == vertices.shape(0));
  require(below(faces.data(), 3 * count, vertices.shape(0)));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  Buffer<float> by_corners;
  by_corners.resize(9 * count);
  const TrianglesBackward in{vertices.data(), faces.data(),          by_rotations.data(), by_centers.data(),
                             by_sizes.data(), by_quaternions.data(), by_corners.data()};
  share_out(count, threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.triangles_backward(in, begin, end); });
  float* out = by_vertices.data();
  std::fill(out, out + 3 * by_vertices.shape(0), 0.0f);
  for (std::size_t corner = 0; corner < 3 * count; ++corner)
    for (int k = 0; k < 3; ++k) out[3 * faces.data()[corner] + k] += by_corners.data()[3 * corner + k];
}

void activate(const Array<const float, -1, 3>& log_scales, const Array<const float, -1, 4>& quats,
              const Array<float, -1, 3>& scales, const Array<float, -1, 4>& unit_quats,
              const std::string& instruction_set, int threads) {
  const std::size_t count = log_scales.shape(0);
  require(quats.shape(0) == count && scales.shape(0) == count && unit_quats.shape(0) == count);
  const Activation in{log_scales.data(), quats.data(), scales.data(), unit_quats.data()};
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  share_out(count, threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.activate(in, begin, end); });
}

// Sum what splats add to the frames of their triangles, each triangle's splats in ascending order.
void sum_by_triangle(const std::int64_t* binding, std::size_t count, const float* parts, std::size_t triangles, int threads,
                     const Array<float, -1, 3, 3>& rotations, const Array<float, -1, 3>& centers,
                     const Array<float, -1>& sizes, const Array<float, -1, 4>& quaternions) {
  std::vector<std::int64_t> starts(triangles + 1, 0), order(count);
  for (std::size_t splat = 0; splat < count; ++splat) ++starts[binding[splat] + 1];
  for (std::size_t triangle = 0; triangle < triangles; ++triangle) starts[triangle + 1] += starts[triangle];
  std::vector<std::int64_t> next(starts.begin(), starts.end() - 1);
  for (std::size_t splat = 0; splat < count; ++splat) order[next[binding[splat]]++] = static_cast<std::int64_t>(splat);
  share_out(triangles, threads, [&](std::int64_t begin, std::int64_t end, int) {
    for (std::int64_t triangle = begin; triangle < end; ++triangle) {
      float sums[kFrameNumbers] = {};
      for (std::int64_t i = starts[triangle]; i < starts[triangle + 1]; ++i)
        for (int k = 0; k < kFrameNumbers; ++k) sums[k] += parts[kFrameNumbers * order[i] + k];
      std::copy(sums, sums + 9, rotations.data() + 9 * triangle);
      std::copy(sums + 9, sums + 12, centers.data() + 3 * triangle);
      sizes.data()[triangle] = sums[12];
      std::copy(sums + 13, sums + 17, quaternions.data() + 4 * triangle);
    }
  });
}

void to_world_backward(const Array<const std::int64_t, -1>& binding, const Array<const float, -1, 3, 3>& rotations,
                       const Array<const float, -1, 3>& centers, const Array<const float, -1>& sizes,
                       const Array<const float, -1, 4>& quaternions, const Array<const float, -1, 3>& means,
                       const Array<const float, -1, 4>& quats, const Array<const float, -1, 3>& scales,
                       const Array<const float, -1, 3>& by_means, const Array<const float, -1, 4>& by_quats,
                       const Array<const float, -1, 3>& by_scales, const Array<float, -1, 3>& by_local_means,
                       const Array<float, -1, 4>& by_raw_quats, const Array<float, -1, 3>& by_log_scales,
                       const Array<float, -1, 3, 3>& by_rotations, const Array<float, -1, 3>& by_centers,
                       const Array<float, -1>& by_sizes, const Array<float, -1, 4>& by_quaternions,
                       const std::string& instruction_set, int threads) {
  const std::size_t count = binding.shape(0), triangles = sizes.shape(0), wanted = by_sizes.shape(0);
  require(rotations.shape(0) == triangles && centers.shape(0) == triangles && quaternions.shape(0) == triangles);
  require(means.shape(0) == count && quats.shape(0) == count && scales.shape(0) == count);
  require(by_means.shape(0) == count && by_quats.shape(0) == count && by_scales.shape(0) == count);
  require(by_local_means.shape(0) == count && by_raw_quats.shape(0) == count && by_log_scales.shape(0) == count);
  require((wanted == triangles || wanted == 0) && by_rotations.shape(0) == wanted && by_centers.shape(0) == wanted);
  require(by_quaternions.shape(0) == wanted && below(binding.data(), count, triangles));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  Buffer<float> parts;
  if (wanted) parts.resize(kFrameNumbers * count);
  const ToWorldBackward in{{binding.data(), rotations.data(), centers.data(), sizes.data(), quaternions.data(), means.data(),
                            nullptr, scales.data(), nullptr, nullptr, nullptr},
                           quats.data(),
                           by_means.data(),
                           by_quats.data(),
                           by_scales.data(),
                           by_local_means.data(),
                           by_raw_quats.data(),
                           by_log_scales.data(),
                           wanted ? parts.data() : nullptr};
  share_out(count, threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.to_world_backward(in, begin, end); });
  if (wanted)
    sum_by_triangle(binding.data(), count, parts.data(), triangles, threads, by_rotations, by_centers, by_sizes,
                    by_quaternions);
}

std::vector<double> penalties(const Array<const float, -1, 3>& means, const Array<const float, -1, 3>& log_scales,
                              const Array<const bool, -1>& visible, float position_threshold, float scale_threshold,
                              float position_weight, float scale_weight, const Array<float, -1, 3>& by_means,
                              const Array<float, -1, 3>& by_log_scales, const std::string& instruction_set, int threads) {
  const std::size_t count = means.shape(0);
  require(log_scales.shape(0) == count && visible.shape(0) == count);
  require(by_means.shape(0) == count && by_log_scales.shape(0) == count);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  const double seen = static_cast<double>(
      std::max<std::int64_t>(1, std::count(visible.data(), visible.data() + count, true)));
  const Penalties in{means.data(),
                     log_scales.data(),
                     visible.data(),
                     position_threshold,
                     scale_threshold,
                     static_cast<float>(position_weight / seen),
                     static_cast<float>(scale_weight / seen),
                     by_means.data(),
                     by_log_scales.data()};
  std::vector<double> sums(2 * ((count + kPerTask - 1) / kPerTask), 0.0);
  share_out(count, threads, [&](std::int64_t begin, std::int64_t end, int) {
    kernels.penalties(in, begin, end, sums.data() + 2 * (begin / kPerTask));
  });
  std::vector<double> means_of(2, 0.0);
  for (std::size_t i = 0; i < sums.size(); ++i) means_of[i % 2] += sums[i] / seen;
  return means_of;
}

TrainedHarmonics harmonics_of(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
                              const Array<const float, -1, 3>& vectors) {
  require(rest.shape(0) == dc.shape(0) && vectors.shape(0) == dc.shape(0) && degree >= 0 && degree <= kDegreeMax);
  require(static_cast<std::size_t>((degree + 1) * (degree + 1) - 1) <= rest.shape(2));
  TrainedHarmonics in{};
  in.degree = degree;
  in.stride = static_cast<std::int64_t>(rest.shape(2));
  in.dc = dc.data();
  in.rest = rest.data();
  in.vectors = vectors.data();
  return in;
}

void harmonics(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
               const Array<const float, -1, 3>& vectors,
               const Array<float, -1, 3>& colors, const std::string& instruction_set, int threads) {
  TrainedHarmonics in = harmonics_of(degree, dc, rest, vectors);
  require(colors.shape(0) == dc.shape(0));
  in.colors = colors.data();
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  share_out(dc.shape(0), threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.harmonics(in, begin, end); });
}

void harmonics_backward(int degree, const Array<const float, -1, 3>& dc, const Array<const float, -1, 3, -1>& rest,
                        const Array<const float, -1, 3>& vectors,
                        const Array<float, -1, 3>& colors, const Array<const float, -1, 3>& by_colors,
                        const Array<float, -1, 3>& by_dc, const Array<float, -1, 3, -1>& by_rest,
                        const Array<float, -1, 3>& by_vectors, const std::string& instruction_set, int threads) {
  TrainedHarmonics in = harmonics_of(degree, dc, rest, vectors);
  const std::size_t count = dc.shape(0);
  require(colors.shape(0) == count && by_colors.shape(0) == count && by_dc.shape(0) == count);
  require(by_rest.shape(0) == count && by_rest.shape(2) == rest.shape(2) && by_vectors.shape(0) == count);
  in.colors = colors.data();
  in.by_colors = by_colors.data();
  in.by_dc = by_dc.data();
  in.by_rest = by_rest.data();
  in.by_vectors = by_vectors.data();
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  share_out(count, threads, [&](std::int64_t begin, std::int64_t end, int) { kernels.harmonics_backward(in, begin, end); });
}

constexpr int kRowsPerTask = 48;

double photometric(const Array<const float, -1, -1, 3>& image, const Array<const float, -1, -1, 3>& truth,
                   const Array<const float, 11>& window, float ssim_weight, const Array<float, -1, -1, 3>& gradient,
                   const std::string& instruction_set, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  require(truth.shape(0) == height && truth.shape(1) == width && gradient.shape(0) == height);
  require(gradient.shape(1) == width && height >= 1 && width >= 1 && height * width < (std::size_t{1} << 28));
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  nb::gil_scoped_release unlocked;
  std::vector<double> l1(height), ssim(height);
  const Photometric in{static_cast<int>(height), static_cast<int>(width), image.data(), truth.data(), window.data(),
                       ssim_weight,              gradient.data(),         l1.data(),    ssim.data()};
  const Scratch scratch(kernels.photometric_scratch(in.width), threads);
  const int tasks = (in.height + kRowsPerTask - 1) / kRowsPerTask;
  ThreadPool::instance().run(tasks, std::max(threads, 1), [&](std::int64_t task, int worker) {
    const int begin = static_cast<int>(task) * kRowsPerTask;
    kernels.photometric(in, begin, std::min(begin + kRowsPerTask, in.height), scratch.of(worker));
  });
  double l1_sum = 0.0, ssim_sum = 0.0;
  for (std::size_t row = 0; row < height; ++row) {
    l1_sum += l1[row];
    ssim_sum += ssim[row];
  }
  const double numbers = 3.0 * static_cast<double>(height) * static_cast<double>(width), weight = ssim_weight;
  return (1.0 - weight) * l1_sum / numbers + weight * (1.0 - ssim_sum / numbers);
}

using Flat = Array<float, -1>;

constexpr std::int64_t kAdamPerTask = 16384;

void adam(const std::vector<Flat>& values, const std::vector<Array<const float, -1>>& gradients,
          const std::vector<Flat>& first, const std::vector<Flat>& second, const std::vector<double>& rates,
          const std::vector<double>& steps, double beta_1, double beta_2, double eps, const std::string& instruction_set,
          int threads) {
  const std::size_t tensors = values.size();
  require(gradients.size() == tensors && first.size() == tensors && second.size() == tensors);
  require(rates.size() == tensors && steps.size() == tensors);
  const Kernels& kernels = variant_of(runnable_kernels(), instruction_set);
  std::vector<AdamStep> parts;
  std::vector<std::pair<std::size_t, std::int64_t>> tasks;  // tensor and first number
  for (std::size_t k = 0; k < tensors; ++k) {
    const std::size_t count = values[k].shape(0);
    require(gradients[k].shape(0) == count && first[k].shape(0) == count && second[k].shape(0) == count);
    parts.push_back({values[k].data(), gradients[k].data(), first[k].data(), second[k].data(),
                     static_cast<float>(1 - beta_1), static_cast<float>(beta_2), static_cast<float>(1 - beta_2),
                     static_cast<float>(rates[k] / (1 - std::pow(beta_1, steps[k]))),
                     static_cast<float>(1 / std::sqrt(1 - std::pow(beta_2, steps[k]))), static_cast<float>(eps)});
    for (std::int64_t begin = 0; begin < static_cast<std::int64_t>(count); begin += kAdamPerTask) tasks.emplace_back(k, begin);
  }
  nb::gil_scoped_release unlocked;
  ThreadPool::instance().run(static_cast<std::int64_t>(tasks.size()), std::max(threads, 1), [&](std::int64_t task, int) {
    const auto [tensor, begin] = tasks[task];
    kernels.adam(parts[tensor], begin, std::min(begin + kAdamPerTask, static_cast<std::int64_t>(values[tensor].shape(0))));
  });
}

}  // namespace

void bind_training(nb::module_& m) {
  m.def("pose", &pose, "neutral"_a, "basis"_a, "weights"_a, "parents"_a, "joints"_a, "by_expression"_a, "expression"_a,
        "angles"_a, "translation"_a, "lids"_a, "unposed"_a, "posed"_a, "instruction_set"_a, "threads"_a,
        "Write the vertices of a head, before and after skinning; empty lids add nothing.");
  m.def("pose_backward", &pose_backward, "neutral"_a, "basis"_a, "weights"_a, "parents"_a, "joints"_a, "by_expression"_a,
        "expression"_a, "angles"_a, "lids"_a, "unposed"_a, "by_posed"_a, "to_expression"_a, "to_angles"_a,
        "to_translation"_a, "instruction_set"_a, "threads"_a, "Write the gradients by expression, angles and translation.");
  m.def("triangles_backward", &triangles_backward, "vertices"_a, "faces"_a, "by_rotations"_a, "by_centers"_a, "by_sizes"_a,
        "by_quaternions"_a, "by_vertices"_a, "instruction_set"_a, "threads"_a, "Write the gradient by a mesh's vertices.");
  m.def("activate", &activate, "log_scales"_a, "quats"_a, "scales"_a, "unit_quats"_a, "instruction_set"_a, "threads"_a,
        "Write scales and unit quaternions of local splats.");
  m.def("to_world_backward", &to_world_backward, "binding"_a, "rotations"_a, "centers"_a, "sizes"_a, "quaternions"_a,
        "means"_a, "quats"_a, "scales"_a, "by_means"_a, "by_quats"_a, "by_scales"_a, "by_local_means"_a, "by_raw_quats"_a,
        "by_log_scales"_a, "by_rotations"_a, "by_centers"_a, "by_sizes"_a, "by_quaternions"_a, "instruction_set"_a,
        "threads"_a, "Write gradients by local splats and, where their arrays are not empty, by triangle frames.");
  m.def("penalties", &penalties, "means"_a, "log_scales"_a, "visible"_a, "position_threshold"_a, "scale_threshold"_a,
        "position_weight"_a, "scale_weight"_a, "by_means"_a, "by_log_scales"_a, "instruction_set"_a, "threads"_a,
        "Means over visible splats of how far means and scales exceed thresholds; writes the weighted sum's gradients.");
  m.def("harmonics", &harmonics, "degree"_a, "dc"_a, "rest"_a, "vectors"_a, "colors"_a, "instruction_set"_a,
        "threads"_a, "Write the colours of spherical harmonics.");
  m.def("harmonics_backward", &harmonics_backward, "degree"_a, "dc"_a, "rest"_a, "vectors"_a, "colors"_a,
        "by_colors"_a, "by_dc"_a, "by_rest"_a, "by_vectors"_a, "instruction_set"_a, "threads"_a,
        "Write the gradients by coefficients and vectors.");
  m.def("photometric", &photometric, "image"_a, "truth"_a, "window"_a, "ssim_weight"_a, "gradient"_a, "instruction_set"_a,
        "threads"_a, "The photometric loss of two images; writes its gradient by the first.");
  m.def("adam", &adam, "values"_a, "gradients"_a, "first"_a, "second"_a, "rates"_a, "steps"_a, "beta_1"_a, "beta_2"_a,
        "eps"_a, "instruction_set"_a, "threads"_a, "Update tensors and their moments, each in its `steps`-th step.");
}

}  // namespace headbench
