// What one core of this machine can do at most, as JSON: read-modify-write of unaligned vectors in the first-level
// cache, and fused multiply-adds in registers. In vectors of the widest kind the compiler was told of.
//
//     c++ -O3 -march=native ceiling.cpp -o ceiling && ./ceiling

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstring>

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Vector __attribute__((vector_size(kLanes * sizeof(float))));

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// The shortest time of many of work(), by the number of things it does.
template <class Work>
double rate(double things, const Work& work) {
  double best = 1e9;
  for (int k = 0; k < 200; ++k) {
    const double begin = seconds();
    work();
    best = std::min(best, seconds() - begin);
  }
  return things / best;
}

void add_to(float* pixels, Vector value) {
  Vector v;
  std::memcpy(&v, pixels, sizeof v);
  v += value;
  std::memcpy(pixels, &v, sizeof v);
}

alignas(64) float memory[8192];

// Vectors one below the other, a row of pixels apart, as a patch of that width has them.
__attribute__((noinline)) void add_rows(float* pixels, int rows, int stride, Vector value) {
  for (int row = 0; row < rows; row += 2, pixels += 2 * stride) add_to(pixels, value), add_to(pixels + stride, value);
}

// Vectors one after the other: stores to the same cache line may be merged, which no patch of that width allows.
__attribute__((noinline)) void add_stream(float* pixels, int count, Vector value) {
  for (int k = 0; k < count; k += 4 * kLanes)
    for (int j = 0; j < 4; ++j) add_to(pixels + k + j * kLanes, value);
}

double rows_rate() {
  constexpr int kRows = 32, kStride = 176, kRepeats = 200;
  const Vector value = Vector{} + 1e-9f;
  return rate(15.0 * kRepeats * kRows * kLanes, [&] {
    for (int k = 0; k < kRepeats; ++k)
      for (int offset = 1; offset < 16; ++offset) add_rows(memory + 9 * offset, kRows, kStride, value);
  });
}

double stream_rate() {
  constexpr int kCount = 4096, kRepeats = 20;
  const Vector value = Vector{} + 1e-9f;
  return rate(15.0 * kRepeats * kCount, [&] {
    for (int k = 0; k < kRepeats; ++k)
      for (int offset = 1; offset < 16; ++offset) add_stream(memory + offset, kCount, value);
  });
}

double fused_rate() {
  constexpr int kChains = 12, kSteps = 10000;
  volatile float one = 1.0f, half = 0.5f;  // nothing is known when this is compiled
  const Vector factor = Vector{} + half;
  Vector sums[kChains];
  for (Vector& sum : sums) sum = Vector{} + one;
  const double result = rate(double(kSteps) * kChains * kLanes, [&] {
    Vector s[kChains];
    std::memcpy(s, sums, sizeof s);
    for (int step = 0; step < kSteps; ++step)
      for (int k = 0; k < kChains; ++k) s[k] = s[k] * factor + factor;
    std::memcpy(sums, s, sizeof s);
  });
  for (const Vector& sum : sums) one = one + sum[0];
  return result;
}

}  // namespace

int main() {
  std::printf("{\"lanes\": %d, \"rows\": %.4e, \"stream\": %.4e, \"fused\": %.4e}\n", kLanes, rows_rate(), stream_rate(),
              fused_rate());
}
