// Light at vertices, and what the camera sees of it.
#pragma once

#include "trace.h"

namespace headbench::HEADBENCH_ISA {

constexpr float kLift = 1e-4f;       // metres above a surface at which rays from it begin
constexpr int kFewShadows = 4;       // rays to each panel; where they disagree, as many as
constexpr int kShadows = 16;
constexpr float kInversePi = 0.318309886f;

// A well mixed number (the finaliser of MurmurHash3).
HEADBENCH_INLINE std::uint32_t mixed(std::uint32_t x) {
  x ^= x >> 16;
  x *= 0x85ebca6bu;
  x ^= x >> 13;
  x *= 0xc2b2ae35u;
  return x ^ (x >> 16);
}

// The first two dimensions of Sobol's sequence, 16 bits each: the first 4, and the first 16, are stratified.
constexpr std::uint16_t kSobol[kShadows][2] = {
    {0x0000, 0x0000}, {0x8000, 0x8000}, {0x4000, 0xc000}, {0xc000, 0x4000}, {0x2000, 0xa000}, {0xa000, 0x2000},
    {0x6000, 0x6000}, {0xe000, 0xe000}, {0x1000, 0xf000}, {0x9000, 0x7000}, {0x5000, 0x3000}, {0xd000, 0xb000},
    {0x3000, 0x5000}, {0xb000, 0xd000}, {0x7000, 0x9000}, {0xf000, 0x1000}};

// An orthonormal frame about a unit vector (Duff et al. 2017).
HEADBENCH_INLINE void frame(Vec3 n, Vec3& s, Vec3& t) {
  const float sign = n.z >= 0.0f ? 1.0f : -1.0f, a = -1.0f / (sign + n.z), b = n.x * n.y * a;
  s = {1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x};
  t = {b, sign + n.y * n.y * a, -n.y};
}

HEADBENCH_INLINE Vec3 normal_of(const Scene& scene, std::int64_t side) {
  const Vec3 n = row(scene.normals, side >> 1);
  return side & 1 ? n * -1.0f : n;
}

HEADBENCH_INLINE Vec3 start_of(const Scene& scene, std::int64_t side, Vec3 normal) {
  return row(scene.vertices, side >> 1) + normal * kLift;
}

inline void direct(const Scene& scene, std::int64_t side) {
  const Panels& panels = scene.panels;
  const Vec3 n = normal_of(scene, side), from = start_of(scene, side, n);
  const std::uint32_t pattern = mixed(static_cast<std::uint32_t>(side) ^ scene.seed);
  Float8 reaching = all(0.0f), passing = all(0.0f);
  unsigned undecided = (1u << kPanels) - 1;
  std::int32_t likely[kPanels] = {};
  for (int shadow = 0; shadow < kShadows && undecided; ++shadow) {
    Float8 s, t;
    for (int p = 0; p < kPanels; ++p) {
      const std::uint32_t scramble = mixed(pattern + static_cast<std::uint32_t>(p));
      s[p] = static_cast<float>(static_cast<std::int32_t>(kSobol[shadow][0] ^ (scramble & 0xffff)) * 2 - 65535) / 65536.0f;
      t[p] = static_cast<float>(static_cast<std::int32_t>(kSobol[shadow][1] ^ (scramble >> 16)) * 2 - 65535) / 65536.0f;
    }
    Float8 d[3], squared = all(0.0f);
    const float origin[3] = {from.x, from.y, from.z};
    for (int axis = 0; axis < 3; ++axis) {
      d[axis] = load(panels.center[axis]) + s * load(panels.half_u[axis]) + t * load(panels.half_v[axis]) - all(origin[axis]);
      squared = squared + d[axis] * d[axis];
    }
    const Float8 at_vertex = d[0] * all(n.x) + d[1] * all(n.y) + d[2] * all(n.z);
    const Float8 at_panel = d[0] * load(panels.normal[0]) + d[1] * load(panels.normal[1]) + d[2] * load(panels.normal[2]);
    const Int8 facing = (at_vertex > all(0.0f)) & (at_panel < all(0.0f)) & (load(panels.area) > all(0.0f));
    const Float8 weight = select(facing, (at_vertex * (all(0.0f) - at_panel)) * load(panels.area) / (squared * squared), all(0.0f));
    const Float8 length = root(squared);
    for (unsigned lit = bits(facing) & undecided; lit; lit &= lit - 1) {
      const int p = __builtin_ctz(lit);
      const float inverse = 1.0f / length[p];
      reaching[p] += weight[p];
      if (!blocked(scene, Ray(from, {d[0][p] * inverse, d[1][p] * inverse, d[2][p] * inverse}), length[p] * 0.999f, likely[p]))
        passing[p] += weight[p];
    }
    if (shadow == kFewShadows - 1) undecided = bits((passing > all(0.0f)) & (passing < reaching));
  }
  Reached& reached = scene.reached[side];
  Vec3 light = {0.0f, 0.0f, 0.0f};
  for (int p = 0; p < kPanels; ++p) {
    const bool more = undecided >> p & 1;
    reached.visible[p] = reaching[p] > 0.0f ? passing[p] / reaching[p] : 0.0f;
    const float share = passing[p] * (kInversePi / static_cast<float>(more ? kShadows : kFewShadows));
    light = light + Vec3{panels.radiance[0][p], panels.radiance[1][p], panels.radiance[2][p]} * share;
  }
  reached.direct[0] = light.x;
  reached.direct[1] = light.y;
  reached.direct[2] = light.z;
}

// The side of a corner that stands for a hit: the corner with the largest weight, the side that the ray comes from.
HEADBENCH_INLINE std::int32_t side_of(const Scene& scene, const Hit& hit, Vec3 along) {
  const std::int32_t* face = scene.faces + 3 * static_cast<std::int64_t>(hit.triangle);
  const Vec3 a = row(scene.vertices, face[0]);
  const Vec3 facing = cross(row(scene.vertices, face[1]) - a, row(scene.vertices, face[2]) - a);
  const float w = 1.0f - hit.u - hit.v;
  const int corner = w >= hit.u && w >= hit.v ? 0 : hit.u >= hit.v ? 1 : 2;
  return 2 * face[corner] + (dot(facing, along) > 0.0f ? 1 : 0);
}

inline void bounce(const Scene& scene, std::int64_t side, std::int32_t* met) {
  const Vec3 n = normal_of(scene, side), from = start_of(scene, side, n);
  Vec3 s, t;
  frame(n, s, t);
  const std::uint32_t pattern = mixed(mixed(static_cast<std::uint32_t>(side) ^ scene.seed) + 77) % static_cast<std::uint32_t>(scene.patterns);
  const float* directions = scene.hemisphere + 3 * static_cast<std::int64_t>(pattern) * scene.rays;
  std::int32_t likely = 0;
  for (std::int32_t ray = 0; ray < scene.rays; ++ray) {
    const Vec3 local = row(directions, ray), along = unit(s * local.x + t * local.y + n * local.z);
    const Hit hit = nearest(scene, Ray(from, along), likely);
    met[ray] = hit.triangle < 0 ? kNothing : side_of(scene, hit, along);
  }
}

struct Surface {
  const std::int32_t* face;
  float weights[3];
  Vec3 normal;  // unit, on the side that is seen
};

HEADBENCH_INLINE Surface surface_of(const Scene& scene, const Sample& sample) {
  Surface surface;
  surface.face = scene.faces + 3 * static_cast<std::int64_t>(sample.triangle);
  surface.weights[0] = 1.0f - sample.u - sample.v;
  surface.weights[1] = sample.u;
  surface.weights[2] = sample.v;
  Vec3 n = {0.0f, 0.0f, 0.0f};
  for (int corner = 0; corner < 3; ++corner)
    n = n + row(scene.normals, surface.face[corner]) * surface.weights[corner];
  surface.normal = unit(sample.back ? n * -1.0f : n);
  return surface;
}

HEADBENCH_INLINE Vec3 place_of(const Scene& scene, const Surface& surface) {
  Vec3 place = {0.0f, 0.0f, 0.0f};
  for (int corner = 0; corner < 3; ++corner)
    place = place + row(scene.vertices, surface.face[corner]) * surface.weights[corner];
  return place;
}

HEADBENCH_INLINE Vec3 mirrored(Vec3 towards, Vec3 normal) { return normal * (2.0f * dot(normal, towards)) - towards; }

HEADBENCH_INLINE void store(float* p, Float8 a) { __builtin_memcpy(p, &a, sizeof a); }

// Try a triangle for the samples of its cells, eight at a time. Triangles come in ascending order, and of equally near ones the
// first stays.
HEADBENCH_INLINE void cover(const Scene& scene, const Strip& strip, std::int32_t triangle, float* const* rays, float* distances,
                            float* us, float* vs) {
  const Extent extent = strip.extents[triangle];
  const std::int32_t* face = scene.faces + 3 * static_cast<std::int64_t>(triangle);
  const Vec3 corner = row(scene.vertices, face[0]);
  const Vec3 edge1 = row(scene.vertices, face[1]) - corner, edge2 = row(scene.vertices, face[2]) - corner;
  const Float8 ax = all(edge1.x), ay = all(edge1.y), az = all(edge1.z);
  const Float8 bx = all(edge2.x), by = all(edge2.y), bz = all(edge2.z);
  const std::int64_t stride = stride_of(strip.columns);
  const std::int64_t top = extent.top > strip.first ? extent.top - strip.first : 0;
  const std::int64_t bottom = extent.bottom < strip.first + strip.rows ? extent.bottom - strip.first : strip.rows;
  for (std::int64_t row = top; row < bottom; ++row) {
    for (std::int64_t column = extent.left; column < extent.right; column += kWide) {
      const std::int64_t i = row * stride + column;
      const Float8 dx = load(rays[0] + i), dy = load(rays[1] + i), dz = load(rays[2] + i);
      const Float8 px = dy * bz - dz * by, py = dz * bx - dx * bz, pz = dx * by - dy * bx;
      const Float8 inverse = all(1.0f) / (ax * px + ay * py + az * pz);
      const Float8 tx = load(rays[3] + i) - all(corner.x), ty = load(rays[4] + i) - all(corner.y), tz = load(rays[5] + i) - all(corner.z);
      const Float8 u = (tx * px + ty * py + tz * pz) * inverse;
      const Float8 qx = ty * az - tz * ay, qy = tz * ax - tx * az, qz = tx * ay - ty * ax;
      const Float8 v = (dx * qx + dy * qy + dz * qz) * inverse;
      const Float8 distance = (bx * qx + by * qy + bz * qz) * inverse, before = load(distances + i);
      const Int8 nearer = (u >= all(-kOverlap)) & (v >= all(-kOverlap)) & (u + v <= all(1.0f + kOverlap)) &
                          (distance > all(0.0f)) & (distance < before);
      if (!bits(nearer)) continue;
      store(distances + i, select(nearer, distance, before));
      store(us + i, select(nearer, u, load(us + i)));
      store(vs + i, select(nearer, v, load(vs + i)));
      for (unsigned found = bits(nearer); found; found &= found - 1) strip.met[i + __builtin_ctz(found)] = triangle;
    }
  }
}

inline void see(const Scene& scene, const Lens& lens, const Strip& strip, Sample* samples) {
  const std::int64_t stride = stride_of(strip.columns), count = strip.rows * stride;
  float* rays[6];
  for (int part = 0; part < 6; ++part) rays[part] = strip.memory + part * count;
  float *distances = strip.memory + 6 * count, *us = strip.memory + 7 * count, *vs = strip.memory + 8 * count;
  const double cell = 1.0 / lens.grid;
  for (std::int64_t i = 0; i < count; ++i) {
    const std::int64_t row = i / stride, column = i % stride;
    distances[i] = kFar;
    us[i] = vs[i] = 0.0f;
    strip.met[i] = -1;
    // Each sample lies anywhere in its cell.
    const std::uint32_t random = mixed(mixed(static_cast<std::uint32_t>(strip.first + row) ^ lens.seed) + static_cast<std::uint32_t>(column));
    const double x = lens.left + (static_cast<double>(column) + ((random & 0xffff) + 0.5) / 65536.0) * cell;
    const double y = lens.top + (static_cast<double>(strip.first + row) + ((random >> 16) + 0.5) / 65536.0) * cell;
    double d[3], squared = 0.0;
    for (int axis = 0; axis < 3; ++axis) {
      d[axis] = lens.columns[0][axis] * x + lens.columns[1][axis] * y + lens.columns[2][axis];
      squared += d[axis] * d[axis];
    }
    const double inverse = 1.0 / __builtin_sqrt(squared);
    for (int axis = 0; axis < 3; ++axis) {
      const double along = d[axis] * inverse;
      rays[axis][i] = static_cast<float>(along);
      rays[3 + axis][i] = static_cast<float>(lens.origin[axis] + lens.start * along);
    }
  }
  for (std::int64_t i = 0; i < strip.count; ++i) cover(scene, strip, strip.triangles[i], rays, distances, us, vs);
  std::int32_t likely = 0;
  for (std::int64_t row = 0; row < strip.rows; ++row) {
    for (std::int64_t column = 0; column < strip.columns; ++column) {
      const std::int64_t i = row * stride + column;
      Sample& sample = samples[row * strip.columns + column];
      sample.triangle = strip.met[i];
      sample.mirrored = kNoMirror;
      if (sample.triangle < 0) continue;
      const Vec3 along = {rays[0][i], rays[1][i], rays[2][i]};
      sample.u = us[i];
      sample.v = vs[i];
      sample.towards = along * -1.0f;
      sample.back = side_of(scene, {distances[i], sample.triangle, sample.u, sample.v}, along) & 1;
      if (scene.materials[scene.material_of[sample.triangle]].roughness > 0.0f) continue;
      const Surface surface = surface_of(scene, sample);
      const Vec3 reflected = mirrored(sample.towards, surface.normal);
      const Hit behind = nearest(scene, Ray(place_of(scene, surface) + surface.normal * kLift, reflected), likely);
      sample.mirrored = behind.triangle < 0 ? kNothing : side_of(scene, behind, reflected);
    }
  }
}

HEADBENCH_INLINE float schlick(float base, float cosine) {
  const float c = 1.0f - cosine, c2 = c * c;
  return base + (1.0f - base) * (c2 * c2 * c);
}

// What a mirror sees where no triangle is: a panel, or the surroundings.
inline Vec3 sky(const Scene& scene, Vec3 from, Vec3 along) {
  const Panels& panels = scene.panels;
  const Float8 nx = load(panels.normal[0]), ny = load(panels.normal[1]), nz = load(panels.normal[2]);
  const Float8 cx = load(panels.center[0]) - all(from.x), cy = load(panels.center[1]) - all(from.y), cz = load(panels.center[2]) - all(from.z);
  const Float8 slope = nx * all(along.x) + ny * all(along.y) + nz * all(along.z);
  const Float8 distance = (cx * nx + cy * ny + cz * nz) / slope;
  const Float8 px = all(along.x) * distance - cx, py = all(along.y) * distance - cy, pz = all(along.z) * distance - cz;
  const Float8 s = (px * load(panels.half_u[0]) + py * load(panels.half_u[1]) + pz * load(panels.half_u[2])) * load(panels.inverse_u2);
  const Float8 t = (px * load(panels.half_v[0]) + py * load(panels.half_v[1]) + pz * load(panels.half_v[2])) * load(panels.inverse_v2);
  const unsigned seen = bits((slope < all(0.0f)) & (distance > all(0.0f)) & (s >= all(-1.0f)) & (s <= all(1.0f)) &
                             (t >= all(-1.0f)) & (t <= all(1.0f)) & (load(panels.area) > all(0.0f)));
  if (!seen) return {scene.surroundings[0], scene.surroundings[1], scene.surroundings[2]};
  const int p = __builtin_ctz(seen);
  return {panels.radiance[0][p], panels.radiance[1][p], panels.radiance[2][p]};
}

// Light of each panel that a GGX surface sends to the viewer, as a share of the panel's radiance. The point of a panel that lies
// nearest to the mirrored ray stands for all of it (Karis 2013, Real Shading in Unreal Engine 4), and the lobe is lowered as if
// the panel's extent, seen in half vectors, widened it: what a mirror-like surface shows is then the panel's radiance.
HEADBENCH_INLINE Float8 glossy(const Scene& scene, Vec3 from, Vec3 n, Vec3 v, const Material& material) {
  const Panels& panels = scene.panels;
  const Vec3 r = mirrored(v, n);
  const Float8 cx = load(panels.center[0]) - all(from.x), cy = load(panels.center[1]) - all(from.y), cz = load(panels.center[2]) - all(from.z);
  const Float8 distance2 = cx * cx + cy * cy + cz * cz, distance = root(distance2);
  const Float8 ux = load(panels.half_u[0]), uy = load(panels.half_u[1]), uz = load(panels.half_u[2]);
  const Float8 vx = load(panels.half_v[0]), vy = load(panels.half_v[1]), vz = load(panels.half_v[2]);
  const Float8 px = all(r.x) * distance - cx, py = all(r.y) * distance - cy, pz = all(r.z) * distance - cz;
  const Float8 one = all(1.0f), zero = all(0.0f);
  const Float8 s = min(max((px * ux + py * uy + pz * uz) * load(panels.inverse_u2), zero - one), one);
  const Float8 t = min(max((px * vx + py * vy + pz * vz) * load(panels.inverse_v2), zero - one), one);
  Float8 lx = cx + s * ux + t * vx, ly = cy + s * uy + t * vy, lz = cz + s * uz + t * vz;
  const Float8 squared = lx * lx + ly * ly + lz * lz, inverse = one / root(squared);
  lx = lx * inverse;
  ly = ly * inverse;
  lz = lz * inverse;
  const Float8 nl = lx * all(n.x) + ly * all(n.y) + lz * all(n.z);
  const Float8 at_panel = zero - (lx * load(panels.normal[0]) + ly * load(panels.normal[1]) + lz * load(panels.normal[2]));
  Float8 hx = lx + all(v.x), hy = ly + all(v.y), hz = lz + all(v.z);
  const Float8 longer = one / root(hx * hx + hy * hy + hz * hz);
  const Float8 nh = (hx * all(n.x) + hy * all(n.y) + hz * all(n.z)) * longer;
  const Float8 vh = (hx * all(v.x) + hy * all(v.y) + hz * all(v.z)) * longer;
  const float alpha2 = material.roughness * material.roughness, nv = dot(n, v) > 1e-3f ? dot(n, v) : 1e-3f;
  const Float8 spread = nh * nh * all(alpha2 - 1.0f) + one;
  const Float8 widened = (all(alpha2) + load(panels.squared_u) / distance2) * (all(alpha2) + load(panels.squared_v) / distance2);
  // alpha^2 of the distribution's peak and alpha^2 of its lowering make alpha^4.
  const Float8 distribution = all(alpha2 * alpha2 * kInversePi) / (spread * spread * root(widened));
  const Float8 masked = nl * all(sqrtf(nv * nv * (1.0f - alpha2) + alpha2)) + all(nv) * root(nl * nl * all(1.0f - alpha2) + all(alpha2));
  const Float8 c = one - vh, c2 = c * c;
  const Float8 fresnel = all(material.specular) + all(1.0f - material.specular) * (c2 * c2 * c);
  const Float8 solid = load(panels.area) * at_panel / squared;
  return select((nl > zero) & (at_panel > zero), distribution * fresnel * all(0.5f) / masked * nl * solid, zero);
}

inline void shade(const Scene& scene, const Sample* samples, std::int64_t count, float* pixels) {
  for (std::int64_t i = 0; i < count; ++i) {
    const Sample& sample = samples[i];
    float* pixel = pixels + 4 * i;
    if (sample.triangle < 0) {
      pixel[0] = pixel[1] = pixel[2] = pixel[3] = 0.0f;
      continue;
    }
    const Surface surface = surface_of(scene, sample);
    const Material& material = scene.materials[scene.material_of[sample.triangle]];
    Vec3 albedo = {0.0f, 0.0f, 0.0f}, light = {0.0f, 0.0f, 0.0f};
    Float8 visible = all(0.0f);
    float gloss = 0.0f;
    for (int corner = 0; corner < 3; ++corner) {
      const float weight = surface.weights[corner];
      const Reached& reached = scene.reached[2 * static_cast<std::int64_t>(surface.face[corner]) + sample.back];
      albedo = albedo + row(scene.albedo, surface.face[corner]) * weight;
      light = light + Vec3{reached.all[0], reached.all[1], reached.all[2]} * weight;
      visible = visible + load(reached.visible) * all(weight);
      gloss += scene.gloss[surface.face[corner]] * weight;
    }
    const float color[3] = {albedo.x * light.x, albedo.y * light.y, albedo.z * light.z};
    float shine[3] = {0.0f, 0.0f, 0.0f};
    float kept = 1.0f;
    if (sample.mirrored != kNoMirror) {
      const float cosine = dot(surface.normal, sample.towards);
      const float share = schlick(material.specular, cosine > 0.0f ? cosine : 0.0f);
      Vec3 seen;
      if (sample.mirrored == kNothing) {
        seen = sky(scene, place_of(scene, surface), mirrored(sample.towards, surface.normal));
      } else {
        const float* reached = scene.reached[sample.mirrored].direct;
        const Vec3 other = row(scene.albedo, sample.mirrored >> 1);
        seen = {other.x * reached[0], other.y * reached[1], other.z * reached[2]};
      }
      shine[0] = share * seen.x;
      shine[1] = share * seen.y;
      shine[2] = share * seen.z;
      kept = 1.0f - share;
    } else if (material.specular > 0.0f) {
      const Float8 sent = glossy(scene, place_of(scene, surface), surface.normal, sample.towards, material) * visible;
      for (int channel = 0; channel < 3; ++channel) shine[channel] = gloss * sum(sent * load(scene.panels.radiance[channel]));
    }
    for (int channel = 0; channel < 3; ++channel) pixel[channel] = color[channel] * kept + shine[channel];
    pixel[3] = 1.0f;
  }
}

}  // namespace headbench::HEADBENCH_ISA
