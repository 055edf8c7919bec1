// Line integrals of voxels by a sparse slice matrix, which all slices share, and the exact adjoint.
//
// The matrix is walked voxel by voxel in both directions, a tile of slices at a time: the wider, the less often it is
// read from memory. Each voxel is read once, and empty ones cost no more than that. Which thread does which slices is
// left to chance; no number depends on it.

#include "abi.hpp"
#include "outline.hpp"
#include "simd.hpp"
#include "threads.hpp"

namespace holo {
namespace {

constexpr int64_t kAhead = 8;  // voxels that are fetched ahead, for they lie far apart in memory

template <int64_t kTile>
struct Tile {  // so many slices' values of one voxel or ray
  Floats<kWidest> part[kTile / kWidest];

  HOLO_INLINE void add(float weight, const float* values) {
    for (int64_t p = 0; p < kTile / kWidest; ++p)
      part[p] = fused<kWidest>(fill<kWidest>(weight), load<kWidest>(values + p * kWidest), part[p]);
  }
  HOLO_INLINE void add_to(float weight, float* values) const {
    for (int64_t p = 0; p < kTile / kWidest; ++p) {
      float* at = values + p * kWidest;
      store<kWidest>(at, fused<kWidest>(fill<kWidest>(weight), part[p], load<kWidest>(at)));
    }
  }
};

template <int64_t kTile>
HOLO_INLINE Tile<kTile> read(const float* from, int64_t count) {
  Tile<kTile> tile;
  if (count == kTile) {
    std::memcpy(&tile, from, sizeof tile);
    return tile;
  }
  alignas(64) float values[kTile] = {};
  std::memcpy(values, from, sizeof(float) * static_cast<size_t>(count));
  std::memcpy(&tile, values, sizeof tile);
  return tile;
}

template <int64_t kTile>
HOLO_INLINE void write(const Tile<kTile>& tile, float* to, int64_t count) {
  if (count == kTile) {
    std::memcpy(to, &tile, sizeof tile);
    return;
  }
  std::memcpy(to, &tile, sizeof(float) * static_cast<size_t>(count));
}

template <int64_t kTile>
bool is_empty(const Tile<kTile>& tile) {
  uint64_t words[sizeof tile / sizeof(uint64_t)], any = 0;
  std::memcpy(words, &tile, sizeof words);
  for (const uint64_t word : words) any |= word;
  return any == 0;
}

template <int64_t kTile>
struct Width {
  static constexpr int64_t value = kTile;
};

// Runs `work(width, first, count, rays)` for every tile of slices, all of a width that leaves each thread some; rays:
// room for [rays, width] numbers.
template <int64_t kTile, class Work>
void each_tile(const HoloSlices& m, int64_t threads, const Work& work) {
  if constexpr (kTile > 16)
    if (m.slices < kTile * threads) return each_tile<kTile / 2>(m, threads, work);
  std::vector<Buffer> rooms(static_cast<size_t>(std::max<int64_t>(1, threads)));
  const int64_t whole = m.slices / kTile, rest = (m.slices - whole * kTile + 15) / 16;  // the rest is narrow
  parallel(whole + rest, threads, [&](int64_t tile, int64_t thread) {
    Buffer& room = rooms[static_cast<size_t>(thread)];
    if (!room.get()) room = Buffer(m.rays * kTile);
    if (tile < whole) return work(Width<kTile>{}, tile * kTile, kTile, room.get());
    const int64_t first = whole * kTile + (tile - whole) * 16;
    work(Width<16>{}, first, std::min<int64_t>(16, m.slices - first), room.get());
  });
}

void project(const HoloSlices& m, const float* volume, float* lines, int64_t threads) {
  each_tile<64>(m, threads, [&](auto width, int64_t first, int64_t count, float* rays) {
    constexpr int64_t kTile = decltype(width)::value;
    std::fill_n(rays, m.rays * kTile, 0.0f);
    for (int64_t v = 0; v < m.voxels; ++v) {
      __builtin_prefetch(volume + std::min(v + kAhead, m.voxels - 1) * m.slices + first);
      const Tile<kTile> values = read<kTile>(volume + v * m.slices + first, count);
      if (is_empty(values)) continue;
      for (int64_t k = m.starts[v]; k < m.starts[v + 1]; ++k) values.add_to(m.weights[k], rays + m.places[k] * kTile);
    }
    for (int64_t r = 0; r < m.rays; ++r)
      write(read<kTile>(rays + r * kTile, kTile), lines + r * m.slices + first, count);
  });
}

void backproject(const HoloSlices& m, const float* lines, float* volume, int64_t threads) {
  each_tile<64>(m, threads, [&](auto width, int64_t first, int64_t count, float* rays) {
    constexpr int64_t kTile = decltype(width)::value;
    for (int64_t r = 0; r < m.rays; ++r)
      write(read<kTile>(lines + r * m.slices + first, count), rays + r * kTile, kTile);
    for (int64_t v = 0; v < m.voxels; ++v) {
      __builtin_prefetch(volume + std::min(v + kAhead, m.voxels - 1) * m.slices + first, 1);
      Tile<kTile> sum{};
      for (int64_t k = m.starts[v]; k < m.starts[v + 1]; ++k) sum.add(m.weights[k], rays + m.places[k] * kTile);
      write(sum, volume + v * m.slices + first, count);
    }
  });
}

}  // namespace
}  // namespace holo

int64_t holosplat_slices_project(const HoloSlices* matrix, const float* volume, float* lines, int64_t threads) {
  return holo::guarded([&] { holo::project(*matrix, volume, lines, threads); });
}

int64_t holosplat_slices_backproject(const HoloSlices* matrix, const float* lines, float* volume, int64_t threads) {
  return holo::guarded([&] { holo::backproject(*matrix, lines, volume, threads); });
}
