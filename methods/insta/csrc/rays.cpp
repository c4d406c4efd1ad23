#include "rays.h"

#include <algorithm>
#include <array>
#include <atomic>

#include "bench/native/thread_pool.h"

namespace headbench::insta {

namespace {

constexpr std::int64_t kMarchedPerTask = 128, kRenderedPerTask = 256;

void put(std::vector<float>& to, Vec3 v) { to.insert(to.end(), {v.x, v.y, v.z}); }

void march_ray(const Marcher& marcher, const Rays& rays, std::int64_t number, std::vector<Interval>& intervals,
               Samples& out) {
  intervals.clear();
  Progress progress = marcher.start(row(rays.origins, number), row(rays.directions, number), rays.jitter[number],
                                    rays.first[number], intervals);
  out.next.push_back(-1);
  Sample sample;
  for (std::int32_t emitted = 0; marcher.next(progress, intervals, sample); ++emitted) {
    if (emitted == rays.samples_max) {
      out.next.back() = sample.index;
      return;
    }
    put(out.positions, sample.position);
    put(out.directions, sample.direction);
    out.distances.push_back(sample.away);
    out.rays.push_back(static_cast<std::int32_t>(number));
    out.indices.push_back(sample.index);
    out.triangles.push_back(sample.triangle);
  }
}

template <class T>
void append(std::vector<T>& whole, const std::vector<T>& part) {
  whole.insert(whole.end(), part.begin(), part.end());
}

// A round's samples of a task's rays, and what the field says of them.
class Round {
 public:
  explicit Round(std::int64_t most) : room_((most + kGroupMax - 1) / kGroupMax * kGroupMax), values_(kRows * room_) {}

  std::int64_t count = 0;

  void add(const Sample& sample, bool mouth) {
    const float values[] = {sample.position.x,  sample.position.y,  sample.position.z, sample.direction.x,
                            sample.direction.y, sample.direction.z, sample.away,       mouth ? 1.0f : 0.0f};
    for (int i = 0; i < 8; ++i) row(i)[count] = values[i];
    ++count;
  }

  Points points() { return {{row(0), row(1), row(2)}, {row(3), row(4), row(5)}, row(6), row(7)}; }
  Values values() { return {row(8), {row(9), row(10), row(11)}}; }

 private:
  static constexpr int kRows = 12;
  float* row(int number) { return values_.data() + number * room_; }

  std::int64_t room_;
  std::vector<float> values_;
};

struct Ray {
  Progress progress;
  std::int64_t number;
  std::int32_t samples;  // of this round
  float left;
  float color[3];
};

}  // namespace

Samples march(const Marcher& marcher, const Rays& rays, int threads) {
  const std::int64_t tasks = (rays.count + kMarchedPerTask - 1) / kMarchedPerTask;
  std::vector<Samples> parts(tasks);
  ThreadPool::instance().run(tasks, threads, [&](std::int64_t task, int) {
    std::vector<Interval> intervals;
    const std::int64_t end = std::min(rays.count, (task + 1) * kMarchedPerTask);
    for (std::int64_t number = task * kMarchedPerTask; number < end; ++number)
      march_ray(marcher, rays, number, intervals, parts[task]);
  });
  Samples whole;
  for (const Samples& part : parts) {
    append(whole.positions, part.positions);
    append(whole.directions, part.directions);
    append(whole.distances, part.distances);
    append(whole.rays, part.rays);
    append(whole.indices, part.indices);
    append(whole.triangles, part.triangles);
    append(whole.next, part.next);
  }
  return whole;
}

std::int64_t render(const Marcher& marcher, const Kernels& kernels, const Field& field, const float* starts,
                    const std::uint8_t* mouth, float step, const RenderRays& all, const Seen& seen, int threads) {
  std::atomic<std::int64_t> evaluated{0};
  ThreadPool::instance().run((all.count + kRenderedPerTask - 1) / kRenderedPerTask, threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kRenderedPerTask, end = std::min(all.count, begin + kRenderedPerTask);
    std::vector<Interval> intervals;
    std::vector<Ray> rays;
    Round round((end - begin) * all.round_samples);
    std::vector<float> scratch(kernels.scratch(field));
    std::int32_t hint = -1;
    for (std::int64_t number = begin; number < end; ++number)
      rays.push_back({marcher.start(row(all.origins, number), row(all.directions, number), all.jitter[number], 0,
                                    intervals),
                      number, 0, 1.0f, {}});
    while (!rays.empty()) {
      round.count = 0;
      for (Ray& ray : rays) {
        // The ray beside this one has met the same triangles.
        if (ray.progress.hint < 0) ray.progress.hint = hint;
        Sample sample;
        for (ray.samples = 0; ray.samples < all.round_samples && marcher.next(ray.progress, intervals, sample);
             ++ray.samples)
          round.add(sample, mouth[sample.triangle] != 0);
        hint = ray.progress.hint;
      }
      kernels.evaluate(field, starts, step, round.points(), round.count, round.values(), scratch.data());
      evaluated += round.count;
      const Values values = round.values();
      std::int64_t at = 0;
      for (Ray& ray : rays) {
        for (const std::int64_t stop = at + ray.samples; at < stop; ++at) {
          const float weight = ray.left * (1 - values.left[at]);
          for (int channel = 0; channel < 3; ++channel) ray.color[channel] += weight * values.color[channel][at];
          ray.left *= values.left[at];
        }
        std::copy(ray.color, ray.color + 3, seen.color + 3 * ray.number);
        seen.transmittance[ray.number] = ray.left;
      }
      rays.erase(std::remove_if(rays.begin(), rays.end(),
                                [&](const Ray& ray) {
                                  return ray.samples < all.round_samples || ray.left < all.stop_transmittance;
                                }),
                 rays.end());
    }
  });
  return evaluated;
}

}  // namespace headbench::insta
