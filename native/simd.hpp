// Vectors of W floats (compiler vector extensions of GCC and clang), and the few functions on them we need.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__FMA__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define HOLO_INLINE inline __attribute__((always_inline))

namespace holo {

// The widest vector of the instruction set this file is compiled for, in floats.
#if defined(__AVX512F__)
constexpr int kWidest = 16;
#elif defined(__AVX2__)
constexpr int kWidest = 8;
#else
constexpr int kWidest = 4;
#endif

template <int W>
struct Simd {
  typedef float F __attribute__((vector_size(W * sizeof(float))));
  typedef int32_t I __attribute__((vector_size(W * sizeof(int32_t))));
  typedef uint32_t U __attribute__((vector_size(W * sizeof(uint32_t))));
};
template <int W>
using Floats = typename Simd<W>::F;
template <int W>
using Ints = typename Simd<W>::I;
template <int W>
using Bits = typename Simd<W>::U;

template <int W>
HOLO_INLINE Floats<W> load(const float* from) {
  Floats<W> v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <int W>
HOLO_INLINE void store(float* to, Floats<W> v) {
  std::memcpy(to, &v, sizeof v);
}

template <int W>
HOLO_INLINE Floats<W> fill(float value) {
  return value - Floats<W>{};  // which compilers know to be a copy, unlike a sum with zero
}

// 0, 1, 2, … W - 1.
template <int W>
HOLO_INLINE Ints<W> lanes() {
  Ints<W> v;
  for (int k = 0; k < W; ++k) v[k] = k;
  return v;
}

template <int W>
HOLO_INLINE Floats<W> as_floats(Ints<W> v) {
  return __builtin_convertvector(v, Floats<W>);
}

// `v` where the mask is set, zero elsewhere.
template <int W>
HOLO_INLINE Floats<W> keep(Ints<W> mask, Floats<W> v) {
  return mask ? v : Floats<W>{};
}

// a b + c, rounded once where the processor can. Compilers fuse nothing on their own here (-ffp-contract=off): they
// may fuse one copy of an inlined function and not another, and results would depend on who called.
template <int W>
HOLO_INLINE Floats<W> fused(Floats<W> a, Floats<W> b, Floats<W> c) {
#if defined(__AVX512F__)
  if constexpr (W == 16) return (Floats<W>)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#endif
#if defined(__FMA__)
  if constexpr (W == 8) return (Floats<W>)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
  if constexpr (W == 4) return (Floats<W>)_mm_fmadd_ps((__m128)a, (__m128)b, (__m128)c);
#elif defined(__aarch64__)
  if constexpr (W == 4) return (Floats<W>)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#endif
  return a * b + c;
}

HOLO_INLINE double fused(double a, double b, double c) {
#if defined(__FMA__) || defined(__aarch64__)
  return __builtin_fma(a, b, c);
#else
  return a * b + c;
#endif
}

#if defined(__clang__) || __GNUC__ >= 12
#define HOLO_SHUFFLE(W, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define HOLO_SHUFFLE(W, a, b, ...) __builtin_shuffle(a, b, holo::Ints<W>{__VA_ARGS__})
#endif

// The sums over lanes of eight vectors, as eight floats: transposed adds, far fewer than eight sums one by one.
HOLO_INLINE void sum_each(const Floats<4>* v, float* sums) {
  for (int m = 0; m < 8; m += 4) {
    const Floats<4> ab = HOLO_SHUFFLE(4, v[m], v[m + 1], 0, 4, 2, 6) + HOLO_SHUFFLE(4, v[m], v[m + 1], 1, 5, 3, 7);
    const Floats<4> cd =
        HOLO_SHUFFLE(4, v[m + 2], v[m + 3], 0, 4, 2, 6) + HOLO_SHUFFLE(4, v[m + 2], v[m + 3], 1, 5, 3, 7);
    store<4>(sums + m, HOLO_SHUFFLE(4, ab, cd, 0, 1, 4, 5) + HOLO_SHUFFLE(4, ab, cd, 2, 3, 6, 7));
  }
}

HOLO_INLINE void sum_each(const Floats<8>* v, float* sums) {
  Floats<8> fours[2];
  for (int m = 0; m < 8; m += 4) {
    const Floats<8> ab = HOLO_SHUFFLE(8, v[m], v[m + 1], 0, 8, 2, 10, 4, 12, 6, 14) +
                         HOLO_SHUFFLE(8, v[m], v[m + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    const Floats<8> cd = HOLO_SHUFFLE(8, v[m + 2], v[m + 3], 0, 8, 2, 10, 4, 12, 6, 14) +
                         HOLO_SHUFFLE(8, v[m + 2], v[m + 3], 1, 9, 3, 11, 5, 13, 7, 15);
    fours[m / 4] =
        HOLO_SHUFFLE(8, ab, cd, 0, 1, 8, 9, 4, 5, 12, 13) + HOLO_SHUFFLE(8, ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
  }
  store<8>(sums, HOLO_SHUFFLE(8, fours[0], fours[1], 0, 1, 2, 3, 8, 9, 10, 11) +
                     HOLO_SHUFFLE(8, fours[0], fours[1], 4, 5, 6, 7, 12, 13, 14, 15));
}

HOLO_INLINE void sum_each(const Floats<16>* v, float* sums) {
  Floats<8> halves[8];
  for (int m = 0; m < 8; ++m) {
    Floats<8> half[2];
    std::memcpy(half, &v[m], sizeof half);
    halves[m] = half[0] + half[1];
  }
  sum_each(halves, sums);
}

// 2^x for -126 <= x <= 126, relative error below 1e-7, and anything at all for other x.
// The polynomial is the degree-6 minimax of 2^f on [-½, ½] (Remez, relative error 2e-9).
template <int W>
HOLO_INLINE Floats<W> exp2(Floats<W> x) {
  const Floats<W> magic = fill<W>(12582912.0f);  // 1.5 · 2^23: adding it rounds to the nearest integer
  const Floats<W> shifted = x + magic;
  const Floats<W> f = x - (shifted - magic);
  Floats<W> p = fill<W>(0.000153458122f);
  p = fused<W>(p, f, fill<W>(0.00133999312f));
  p = fused<W>(p, f, fill<W>(0.00961848896f));
  p = fused<W>(p, f, fill<W>(0.0555032878f));
  p = fused<W>(p, f, fill<W>(0.240226469f));
  p = fused<W>(p, f, fill<W>(0.693147206f));
  p = fused<W>(p, f, fill<W>(1.0f));
  const Bits<W> exponent = (Bits<W>)shifted << 23;  // the integer sits in the low bits; the others are shifted out
  return (Floats<W>)((Bits<W>)p + exponent);
}

// 2^x for any x <= 0; 2^-120 for anything smaller than -120 (nobody sees it).
template <int W>
HOLO_INLINE Floats<W> fade(Floats<W> x) {
  return exp2<W>(x > -120.0f ? x : fill<W>(-120.0f));
}

}  // namespace holo
