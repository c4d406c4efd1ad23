#include "march.h"

#include <algorithm>

#include "../../splats/csrc/thread_pool.h"

namespace headbench::insta {

namespace {

constexpr std::int64_t kRaysPerTask = 128;

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

}  // namespace

Samples march(const Marcher& marcher, const Rays& rays, int threads) {
  const std::int64_t tasks = (rays.count + kRaysPerTask - 1) / kRaysPerTask;
  std::vector<Samples> parts(tasks);
  ThreadPool::instance().run(tasks, threads, [&](std::int64_t task, int) {
    std::vector<Interval> intervals;
    const std::int64_t end = std::min(rays.count, (task + 1) * kRaysPerTask);
    for (std::int64_t number = task * kRaysPerTask; number < end; ++number)
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

}  // namespace headbench::insta
