#include "rays.h"

#include <algorithm>
#include <atomic>

#include "bench/native/parallel.h"

namespace headbench::insta {

namespace {

constexpr std::int64_t kMarchedPerTask = 128, kRenderedPerTask = 256;

void put(std::vector<float>& to, Vec3 v) { to.insert(to.end(), {v.x, v.y, v.z}); }

// The next samples of one ray: those of training are drawn at random, and few lie together.
void march(const Marcher& marcher, const Rays& rays, std::int64_t number, std::int32_t first, std::int32_t samples_max,
           Samples& out) {
  std::vector<Interval> intervals;
  Progress progress{row(rays.origins, number), row(rays.directions, number), rays.jitter[number], first};
  std::int32_t count = 0;
  marcher.start(&progress, 1, intervals);
  marcher.march(&progress, 1, intervals, [&](int, const Sample& sample) {
    put(out.positions, sample.position);
    put(out.directions, sample.direction);
    out.distances.push_back(sample.away);
    out.rays.push_back(static_cast<std::int32_t>(number));
    out.indices.push_back(sample.index);
    out.triangles.push_back(sample.triangle);
    return ++count < samples_max;
  });
  out.next.push_back(count < samples_max ? -1 : progress.index);
}

template <class T>
void append(std::vector<T>& whole, const std::vector<T>& part) {
  whole.insert(whole.end(), part.begin(), part.end());
}

// A round's samples of a task's rays, and what the field says of them.
class Round {
 public:
  explicit Round(std::int64_t most) : room_((most + kGroupMax - 1) / kGroupMax * kGroupMax), values_(kRows * room_), rays_(room_) {}

  std::int64_t count = 0;

  void add(const Sample& sample, bool mouth, std::int32_t ray) {
    rays_[count] = ray;
    const float values[] = {sample.position.x,  sample.position.y,  sample.position.z, sample.direction.x,
                            sample.direction.y, sample.direction.z, sample.away,       mouth ? 1.0f : 0.0f};
    for (int i = 0; i < 8; ++i) row(i)[count] = values[i];
    ++count;
  }

  Points points() { return {{row(0), row(1), row(2)}, {row(3), row(4), row(5)}, row(6), row(7)}; }
  const std::int32_t* rays() const { return rays_.data(); }  // whose a sample is
  Values values() { return {row(8), {row(9), row(10), row(11)}}; }

 private:
  static constexpr int kRows = 12;
  float* row(int number) { return values_.data() + number * room_; }

  std::int64_t room_;
  std::vector<float> values_;
  std::vector<std::int32_t> rays_;
};

// What a task's rays have gathered so far.
struct Gathered {
  std::int64_t number;
  std::int32_t samples;  // of this round
  float left;
};

}  // namespace

Samples march(const Marcher& marcher, const Rays& rays, const std::int32_t* first, std::int32_t samples_max, int threads) {
  std::vector<Samples> parts(divided_up(rays.count, kMarchedPerTask));
  parallel_for(rays.count, kMarchedPerTask, threads, [&](std::int64_t begin, std::int64_t end) {
    Samples& part = parts[begin / kMarchedPerTask];
    for (std::int64_t number = begin; number < end; ++number)
      march(marcher, rays, number, first[number], samples_max, part);
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
                    const std::uint8_t* mouth, float step, const Rays& all, const Rounds& rounds, const Seen& seen,
                    int threads) {
  std::atomic<std::int64_t> evaluated{0};
  const Scratch scratch(kernels.scratch(field), threads);
  parallel_for(all.count, kRenderedPerTask, threads, [&](std::int64_t begin, std::int64_t end, int worker) {
    std::vector<Interval> intervals;
    std::vector<Progress> rays;  // that go on, and beside each what it has gathered
    std::vector<Gathered> gathered;
    Round round((end - begin) * rounds.samples);
    std::fill(seen.color + 3 * begin, seen.color + 3 * end, 0.0f);
    for (std::int64_t number = begin; number < end; ++number) {
      rays.push_back({row(all.origins, number), row(all.directions, number), all.jitter[number], 0});
      gathered.push_back({number, 0, 1.0f});
    }
    std::size_t count = rays.size();
    for (std::size_t first = 0; first < count; first += kLanes)
      marcher.start(rays.data() + first, static_cast<int>(std::min<std::size_t>(kLanes, count - first)), intervals);
    while (count > 0) {
      round.count = 0;
      for (std::size_t first = 0; first < count; first += kLanes) {
        Gathered* const group = gathered.data() + first;
        const int together = static_cast<int>(std::min<std::size_t>(kLanes, count - first));
        for (int i = 0; i < together; ++i) group[i].samples = 0;
        marcher.march(rays.data() + first, together, intervals, [&](int ray, const Sample& sample) {
          round.add(sample, mouth[sample.triangle] != 0, static_cast<std::int32_t>(first) + ray);
          return ++group[ray].samples < rounds.samples;
        });
      }
      kernels.evaluate(field, starts, step, round.points(), round.count, round.values(), scratch.of(worker));
      evaluated += round.count;
      const Values values = round.values();
      for (std::int64_t at = 0; at < round.count; ++at) {
        Gathered& ray = gathered[round.rays()[at]];
        const float weight = ray.left * (1 - values.left[at]);
        for (int channel = 0; channel < 3; ++channel)
          seen.color[3 * ray.number + channel] += weight * values.color[channel][at];
        ray.left *= values.left[at];
      }
      std::size_t kept = 0;
      for (std::size_t i = 0; i < count; ++i) {
        seen.transmittance[gathered[i].number] = gathered[i].left;
        if (gathered[i].samples < rounds.samples || gathered[i].left < rounds.stop_transmittance) continue;
        rays[kept] = rays[i];
        gathered[kept++] = gathered[i];
      }
      count = kept;
    }
  });
  return evaluated;
}

}  // namespace headbench::insta
