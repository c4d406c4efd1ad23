// The renderer's and the avatars' functions for one instruction set; compiled once for each.
#include "bench/native/simd.h"

#include "backward.h"
#include "binning.h"
#include "forward.h"
#include "network_passes.h"
#include "networks.h"
#include "projection_backward.h"
#include "training.h"

namespace headbench::HEADBENCH_ISA {

// What the speed benchmark asks besides times: how much work a drawn frame was, and what the processor could do at best.

// Count the work of drawing a tile that was drawn before.
inline void count_work(const Camera& view, const Splats& splats, const FrameData& frame, int tile, float* scratch,
                       Work& work) {
  const int count = static_cast<int>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
  const int stride = record_stride(splats.channels);
  Chunk chunk;
  chunk.params = scratch;
  for (int begin = 0; begin < count; begin += kChunk) {
    const int end = begin + kChunk < count ? begin + kChunk : count;
    fill_chunk<0>(view, splats, frame, tile, begin, end, ~std::uint64_t{0}, chunk);
    for (int b = 0; b < kBlocks; ++b) {
      const Block block = block_of(view, tile, b);
      if (!any(block.inside)) continue;  // never drawn, so that nothing is stored of it
      const Real last = load(frame.last + static_cast<std::size_t>(tile) * kTilePixels + b * W);
      for (int i = 0; i < end - begin; ++i) {
        if (!(chunk.hits_of(b)[i / kWordBits] >> i % kWordBits & 1)) continue;
        const float* row = chunk.params + i * stride;
        const Mask reached = last >= Real(row[kIndex]);
        if (!any(reached)) break;
        alignas(64) float drawn[W];
        store(drawn, zero_unless(alpha_of(view, row, block).passes & reached, 1.0f));
        work.tested += W;
        for (int lane = 0; lane < W; ++lane) work.drawn += drawn[lane] != 0.0f;
      }
    }
  }
}

constexpr int kChains = 12;  // independent multiply-adds in flight: more than latency times ports

// Do `rounds` * kChains vector multiply-adds; the result only keeps the compiler from dropping them.
inline float multiply_add(std::int64_t rounds) {
  Real chain[kChains];
  for (int k = 0; k < kChains; ++k) chain[k] = static_cast<float>(k);
  const Real factor = 0.999f, term = 0.001f;
  for (std::int64_t round = 0; round < rounds; ++round)
    for (int k = 0; k < kChains; ++k) chain[k] = fma(chain[k], factor, term);
  Real sum = 0.0f;
  for (int k = 0; k < kChains; ++k) sum = sum + chain[k];
  alignas(64) float lanes[W];
  store(lanes, sum);
  return lanes[0];
}

inline std::size_t scratch_floats(int channels) {
  const std::size_t forward = forward_scratch(channels), backward = backward_scratch(channels);
  return forward > backward ? forward : backward;
}

extern const Kernels kernels;
const Kernels kernels = {HEADBENCH_ISA_NAME, W, project, find_entries, scratch_floats, draw_tile, draw_tile_backward,
                         project_backward, count_work, multiply_add, kChains, triangles, to_world, shade, turns,
                         color_network, offset_scratch, offset_network,
                         triangles_backward, activate, to_world_backward, harmonics<false>, harmonics<true>,
                         photometric_scratch, photometric};

}  // namespace headbench::HEADBENCH_ISA
