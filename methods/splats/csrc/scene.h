// What a rendering call and an avatar's pose work on: plain data, shared by all instruction sets.
//
// N splats, C channels, P pairs of a tile and a splat that touches it. There is no inline code here,
// see bench/native/simd.h.
#pragma once

#include <cstddef>
#include <cstdint>

namespace headbench {

// The constants of methods/splats/constants.py.
constexpr int kTile = 16;
constexpr int kTilePixels = kTile * kTile;
constexpr float kAlphaMax = 0.99f;
constexpr float kFrustumMargin = 0.3f;
constexpr float kQuaternionMin = 1e-12f;
constexpr float kRadiusMax = 16777216.0f;
constexpr int kChannelsMax = 32;

// A record holds what drawing needs of a splat: kGeometry numbers, then the colour. A mean is the sum of a float and
// a rest below its last digit: hundreds of pixels from the image's corner one float would be off by 3e-5 pixels, which
// shows in sharp splats.
constexpr int kRecordUnit = 16;  // floats: records are whole cache lines, as drawing reads them at random
enum RecordField { kMeanX, kMeanY, kL11, kL21, kL22, kLog2Opacity, kRestX, kRestY, kGeometry };

// A gradient record holds moments of the alpha gradient over pixels, then the gradient of the colour.
enum GradientField { kSum, kSumX, kSumY, kSumXX, kSumXY, kSumYY, kMoments };

// Rows of the rotation, the translation, then fx, fy, cx, cy.
constexpr int kViewGradient = 16;

struct Camera {
  float rotation[9], translation[3];
  float fx, fy, cx, cy;
  double near, far;
  float eps2d;
  float alpha_min, log2_alpha_min, transmittance_min;
  bool antialiased;  // opacities are multiplied by the square root of the ratio of determinants without and with eps2d
  int width, height;
  int tiles_x, tiles_y;
};

// Inputs, as the caller's arrays.
struct Splats {
  std::int64_t count;
  int channels;
  const float* means;       // (N, 3)
  const float* quats;       // (N, 4)
  const float* scales;      // (N, 3)
  const float* opacities;   // (N,)
  const float* colors;      // (N, C)
  const float* offset;      // (N, 2) or null
  const float* background;  // (C,)
};

// Tiles a splat may touch, last ones included.
struct Rect {
  std::uint16_t x0, y0, x1, y1;
};

// A tile that a splat reaches. Bit `4 band + column` of `blocks` tells whether the splat reaches that block of
// the tile.
struct Entry {
  std::uint64_t blocks;
  std::uint32_t tile;
};

// The entries of one splat, neighbours.
struct EntryRange {
  std::uint32_t begin, count;
};

// A splat in a tile's list.
struct Pair {
  std::uint64_t blocks;
  std::uint32_t splat;
};

// What the kernels hand on to each other.
struct FrameData {
  float* records;                // (N, record_stride(C)), set for drawn splats
  double* depths;                // (N,) camera z, 0 where not drawn
  std::int32_t* radii;           // (N,) 0 where out of view; what is too faint to be drawn has one
  Rect* rects;                   // (N,)
  EntryRange* ranges;            // (N,) set for drawn splats
  Entry* entries;                // before they are sorted into pairs
  const std::uint32_t* drawn;  // (M,) ascending
  const std::uint32_t* order;    // (M,) by depth
  Pair* pairs;                   // (P,) tile by tile, each by depth
  std::uint32_t* places;         // of each entry among the pairs
  std::uint32_t* tile_begin;     // (tiles + 1,)
  float* transmittances;         // (tiles, 256) in block order
  float* last;                   // (tiles, 256) index in the tile's list of the pixel's last splat, or -1
};

struct ImageOut {
  float* image;  // (H, W, C)
  float* alpha;  // (H, W)
};

struct Gradients {
  const float* image;      // (H, W, C)
  const float* alpha;      // (H, W)
  int record_stride;       // floats per gradient record
  float* records;          // (P, record_stride) gradient records of the pairs
  double* background;      // (tiles, C)
  float* means;            // (N, 3)
  float* quats;            // (N, 4)
  float* scales;           // (N, 3)
  float* opacities;        // (N,)
  float* colors;           // (N, C)
  float* means2d;          // (N, 2) or null
};

// The work of drawing a frame, in pairs of a splat and a pixel.
struct Work {
  std::uint64_t tested = 0;  // alpha was computed
  std::uint64_t drawn = 0;   // the splat contributed to the pixel
};

// What an avatar computes of a pose before its splats are drawn: F triangles.

// Frames of the triangles of a mesh of V vertices.
struct Triangles {
  const float* vertices;      // (V, 3)
  const std::int64_t* faces;  // (F, 3)
  float* rotations;           // (F, 3, 3)
  float* centers;             // (F, 3)
  float* sizes;               // (F,)
  float* quaternions;         // (F, 4)
};

// Rotations from posed triangles to those of another mesh, to^T of the first applied before the second.
struct Turns {
  const float* to;    // (F, 3, 3)
  const float* from;  // (F, 3, 3)
  float* turns;       // (F, 3, 3) to times the transpose of from
};

// Splats from their triangles' frames to the world; the formulas of binding.py, `to_world`.
struct ToWorld {
  const std::int64_t* binding;  // (N,) triangles
  const float* rotations;       // (F, 3, 3)
  const float* centers;         // (F, 3)
  const float* sizes;           // (F,)
  const float* quaternions;     // (F, 4)
  const float* means;           // (N, 3)
  const float* quats;           // (N, 4) unit
  const float* scales;          // (N, 3)
  float* world_means;           // (N, 3)
  float* world_quats;           // (N, 4)
  float* world_scales;          // (N, 3)
};

// Number of splats per block of coefficients; values of one coefficient in a block are contiguous.
constexpr int kHarmonicsBlock = 16;
constexpr int kDegreeMax = 3;

// Colours of spherical harmonics along the directions from the camera to the splats; the formulas of `sh_to_rgb` in
// methods/ops/planes.py.
struct Harmonics {
  int degree;
  const float* coefficients;    // (ceil(N / 16), 3, (degree + 1)^2, 16)
  const float* means;           // (N, 3) in the world
  const float* rotations;       // (F, 3, 3) applied to the directions, or null
  const std::int64_t* binding;  // (N,) triangles; null without rotations
  const float* center;          // (3,) of the camera
  float* colors;                // (N, 3)
};

// Both networks' layers are this wide, or multiples of it.
constexpr int kUnitsStep = 16;
// Splats that go through one layer before the next: what they keep between them stays in the first caches.
constexpr int kNetworkTile = 64;

// The colour network, `shader` in methods/ops/planes.py: what is known of the position, plus what the direction
// from the splat to the camera adds, ReLU, a layer. Each coordinate of the direction adds its own part, which a table holds
// at equidistant samples from -1 to 1.
struct ColorNetwork {
  int hidden, samples;
  const std::int16_t* positions;   // (N, hidden) in steps
  const float* steps;           // (hidden,)
  const float* table;           // (3 samples, hidden)
  const float* last;            // (3, hidden)
  const float* means;           // (N, 3) in the world
  const float* rotations;       // (F, 3, 3) applied to the directions
  const std::int64_t* binding;  // (N,) triangles
  const float* center;          // (3,) of the camera
  float* colors;                // (N, 3)
};

// The offset network, `OffsetLayers` in methods/ops/planes.py, for M splats: rows of a table interpolated on three
// axes and added, ReLU, a layer, ReLU, a layer.
struct OffsetNetwork {
  int units, hidden, outputs;
  int second_stride;          // numbers from one row of `second` to the next
  const float* table;         // (T, units), T > rows + 1
  const float* first_bias;    // (units,)
  const std::int32_t* rows;   // (M, 3) the lower of two neighbours
  const float* fractions;     // (M, 3) from the lower to the upper
  const float* second;        // (units, hidden)
  const float* second_bias;   // (hidden,)
  const float* last;          // (outputs, hidden)
  const float* last_bias;     // (outputs,)
  const std::int64_t* splats; // (M,) which splat each is
  float* offsets;             // (N, outputs)
  float* kept;                // (M to whole tiles, hidden) the second layer after its ReLU, where it is asked for
};

// What training computes of splats beside the rasteriser; gradients are named by what they are taken by.

struct TrianglesBackward {
  const float* vertices;        // (V, 3)
  const std::int64_t* faces;    // (F, 3)
  const float* by_rotations;    // (F, 3, 3)
  const float* by_centers;      // (F, 3)
  const float* by_sizes;        // (F,)
  const float* by_quaternions;  // (F, 4)
  float* by_corners;            // (F, 3, 3)
};

struct Activation {
  const float* log_scales;  // (N, 3)
  const float* quats;       // (N, 4) of any length
  float* scales;            // (N, 3)
  float* unit_quats;        // (N, 4)
};

// Gradients of a triangle's frame: rotation, centre, size, quaternion.
constexpr int kFrameNumbers = 9 + 3 + 1 + 4;

struct ToWorldBackward {
  ToWorld splats;          // what `to_world` read, with quaternions of any length
  const float* by_means;   // (N, 3) in the world
  const float* by_quats;   // (N, 4)
  const float* by_scales;  // (N, 3)
  float* by_local_means;   // (N, 3)
  float* by_raw_quats;     // (N, 4)
  float* by_log_scales;    // (N, 3)
  float* by_frames;        // (N, kFrameNumbers) or null
};

// As `Harmonics`, with coefficients as training holds them.
struct TrainedHarmonics {
  int degree;
  std::int64_t stride;     // coefficients a channel in `rest`
  const float* dc;         // (N, 3)
  const float* rest;       // (N, 3, stride)
  const float* vectors;    // (N, 3) from the camera to the splats, of any length
  float* colors;           // (N, 3)
  const float* by_colors;  // (N, 3)
  float* by_dc;            // (N, 3)
  float* by_rest;          // (N, 3, stride)
  float* by_vectors;       // (N, 3)
};

// (1 - w) mean|image - truth| + w (1 - mean SSIM) of methods/ops/photometric.py, and its gradient by the image.
struct Photometric {
  int height, width;
  const float* image;   // (H, W, 3)
  const float* truth;   // (H, W, 3)
  const float* window;  // (11,)
  float ssim_weight;
  float* gradient;   // (H, W, 3)
  double* row_l1;    // (H,) sums
  double* row_ssim;  // (H,)
};

// The functions compiled for one instruction set.
struct Kernels {
  const char* name;
  int lanes;
  // Project splats [begin, end): records, depths, radii, rects.
  void (*project)(const Camera&, const Splats&, const FrameData&, std::int64_t begin, std::int64_t end);
  // Find the tiles and blocks that splats drawn[begin .. end) reach.
  void (*find_entries)(const Camera&, const Splats&, const FrameData&, std::int64_t begin, std::int64_t end);
  std::size_t (*scratch_floats)(int channels);
  void (*draw_tile)(const Camera&, const Splats&, const FrameData&, const ImageOut&, int tile, float* scratch);
  void (*draw_tile_backward)(const Camera&, const Splats&, const FrameData&, const Gradients&, int tile,
                             float* scratch);
  // Gather the gradient records of splats drawn[begin .. end) and take them back to the inputs; adds to
  // view_gradient (kViewGradient numbers).
  void (*project_backward)(const Camera&, const Splats&, const FrameData&, const Gradients&,
                           std::int64_t begin, std::int64_t end, double* view_gradient);
  // For the speed bench alone.
  void (*count_work)(const Camera&, const Splats&, const FrameData&, int tile, float* scratch, Work& work);
  float (*multiply_add)(std::int64_t rounds);  // `chains` vectors a round
  int chains;
  // Of avatars, for triangles or splats [begin, end).
  void (*triangles)(const Triangles&, std::int64_t begin, std::int64_t end);
  void (*to_world)(const ToWorld&, std::int64_t begin, std::int64_t end);
  void (*shade)(const Harmonics&, std::int64_t begin, std::int64_t end);
  void (*turns)(const Turns&, std::int64_t begin, std::int64_t end);
  void (*color_network)(const ColorNetwork&, std::int64_t begin, std::int64_t end);
  std::size_t (*offset_scratch)(const OffsetNetwork&);
  void (*offset_network)(const OffsetNetwork&, std::int64_t begin, std::int64_t end, float* scratch);
  // Of training, for triangles, splats or rows [begin, end).
  void (*triangles_backward)(const TrianglesBackward&, std::int64_t begin, std::int64_t end);
  void (*activate)(const Activation&, std::int64_t begin, std::int64_t end);
  void (*to_world_backward)(const ToWorldBackward&, std::int64_t begin, std::int64_t end);
  void (*harmonics)(const TrainedHarmonics&, std::int64_t begin, std::int64_t end);
  void (*harmonics_backward)(const TrainedHarmonics&, std::int64_t begin, std::int64_t end);
  std::size_t (*photometric_scratch)(int width);
  void (*photometric)(const Photometric&, int begin, int end, float* scratch);
};

}  // namespace headbench
