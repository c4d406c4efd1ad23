#include "render.h"

#include <algorithm>
#include <array>
#include <atomic>

#include "../../splats/csrc/thread_pool.h"

namespace headbench::insta {

namespace {

constexpr std::int64_t kRaysPerTask = 256;

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

std::int64_t render(const Marcher& marcher, const InstructionSet& set, const Field& field, const float* starts,
                    const std::uint8_t* mouth, float step, const View& view, const Seen& seen, int threads) {
  std::atomic<std::int64_t> evaluated{0};
  ThreadPool::instance().run((view.count + kRaysPerTask - 1) / kRaysPerTask, threads, [&](std::int64_t task, int) {
    const std::int64_t begin = task * kRaysPerTask, end = std::min(view.count, begin + kRaysPerTask);
    std::vector<Interval> intervals;
    std::vector<Ray> rays;
    Round round((end - begin) * view.round_samples);
    std::vector<float> scratch(set.scratch(field));
    std::int32_t hint = -1;
    for (std::int64_t number = begin; number < end; ++number)
      rays.push_back({marcher.start(row(view.origins, number), row(view.directions, number), view.jitter[number], 0,
                                    intervals),
                      number, 0, 1.0f, {}});
    while (!rays.empty()) {
      round.count = 0;
      for (Ray& ray : rays) {
        // The ray beside this one has met the same triangles.
        if (ray.progress.hint < 0) ray.progress.hint = hint;
        Sample sample;
        for (ray.samples = 0; ray.samples < view.round_samples && marcher.next(ray.progress, intervals, sample);
             ++ray.samples)
          round.add(sample, mouth[sample.triangle] != 0);
        hint = ray.progress.hint;
      }
      set.evaluate(field, starts, step, round.points(), round.count, round.values(), scratch.data());
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
                                  return ray.samples < view.round_samples || ray.left < view.stop_transmittance;
                                }),
                 rays.end());
    }
  });
  return evaluated;
}

}  // namespace headbench::insta
