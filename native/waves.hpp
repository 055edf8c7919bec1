// Vectors of complex numbers, and the wave behind an object.
//
// The polynomials are Chebyshev fits (sine and cosine: relative error 1e-8; exponential: 4e-9), made with mpmath;
// angles are reduced with pi/2 in three parts, and exponents with ln 2 in two (Cody & Waite 1980).
#pragma once

#include <cstring>

#include "simd.hpp"

namespace holo {

template <int W>
struct Wave {
  Floats<W> re, im;
};

// W complex numbers from or to pairs (re, im) in memory.
template <int W>
HOLO_INLINE Wave<W> load_wave(const float* from) {
  const Floats<W> a = load<W>(from), b = load<W>(from + W);
  if constexpr (W == 16) {
    return {HOLO_SHUFFLE(16, a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30),
            HOLO_SHUFFLE(16, a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31)};
  } else if constexpr (W == 8) {
    return {HOLO_SHUFFLE(8, a, b, 0, 2, 4, 6, 8, 10, 12, 14), HOLO_SHUFFLE(8, a, b, 1, 3, 5, 7, 9, 11, 13, 15)};
  } else {
    return {HOLO_SHUFFLE(4, a, b, 0, 2, 4, 6), HOLO_SHUFFLE(4, a, b, 1, 3, 5, 7)};
  }
}

template <int W>
HOLO_INLINE void store_wave(float* to, Wave<W> u) {
  if constexpr (W == 16) {
    store<16>(to, HOLO_SHUFFLE(16, u.re, u.im, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23));
    store<16>(to + 16, HOLO_SHUFFLE(16, u.re, u.im, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31));
  } else if constexpr (W == 8) {
    store<8>(to, HOLO_SHUFFLE(8, u.re, u.im, 0, 8, 1, 9, 2, 10, 3, 11));
    store<8>(to + 8, HOLO_SHUFFLE(8, u.re, u.im, 4, 12, 5, 13, 6, 14, 7, 15));
  } else {
    store<4>(to, HOLO_SHUFFLE(4, u.re, u.im, 0, 4, 1, 5));
    store<4>(to + 4, HOLO_SHUFFLE(4, u.re, u.im, 2, 6, 3, 7));
  }
}

// The first `count` of them; the others are zero, or left as they are in memory.
template <int W>
HOLO_INLINE Wave<W> load_some_waves(const float* from, int64_t count) {
  if (count == W) return load_wave<W>(from);
  alignas(64) float pairs[2 * W] = {};
  std::memcpy(pairs, from, 2 * count * sizeof(float));
  return load_wave<W>(pairs);
}

template <int W>
HOLO_INLINE void store_some_waves(float* to, Wave<W> u, int64_t count) {
  if (count == W) return store_wave<W>(to, u);
  alignas(64) float pairs[2 * W];
  store_wave<W>(pairs, u);
  std::memcpy(to, pairs, 2 * count * sizeof(float));
}

// The integer nearest to each |x| < 2^22, as a float; its low bits are those of `bits`.
template <int W>
HOLO_INLINE Floats<W> nearest(Floats<W> x, Ints<W>& bits) {
  const Floats<W> magic = fill<W>(12582912.0f), shifted = x + magic;
  bits = (Ints<W>)shifted;
  return shifted - magic;
}

// a where the mask is set, b elsewhere.
template <int W>
HOLO_INLINE Floats<W> choose(Ints<W> mask, Floats<W> a, Floats<W> b) {
  return (Floats<W>)(((Ints<W>)a & mask) | ((Ints<W>)b & ~mask));
}

template <int W>
HOLO_INLINE void sine_cosine(Floats<W> x, Floats<W>& sine, Floats<W>& cosine) {
  Ints<W> quadrant;
  const Floats<W> n = nearest<W>(x * 0.636619772f, quadrant);
  Floats<W> r = fused<W>(n, fill<W>(-1.5703125f), x);
  r = fused<W>(n, fill<W>(-4.83751297e-4f), r);
  r = fused<W>(n, fill<W>(-7.54978995e-8f), r);
  // Phases of more than 1e7 have no digits left to be reduced by; the wave must stay on its circle all the same.
  r = r > 1.6f ? fill<W>(1.6f) : r;
  r = r < -1.6f ? fill<W>(-1.6f) : r;
  const Floats<W> z = r * r;
  Floats<W> s = fused<W>(fill<W>(-0.000195854334f), z, fill<W>(0.00833273693f));
  s = fused<W>(s, z, fill<W>(-0.166666646f));
  s = fused<W>(s * z, r, r);
  Floats<W> c = fused<W>(fill<W>(2.45454283e-05f), z, fill<W>(-0.00138882913f));
  c = fused<W>(c, z, fill<W>(0.0416666646f));
  c = fused<W>(c * z, z, fused<W>(fill<W>(-0.5f), z, fill<W>(1.0f)));
  const Ints<W> odd = (quadrant & 1) != 0;
  const Ints<W> sine_sign = (quadrant & 2) << 30, cosine_sign = ((quadrant + 1) & 2) << 30;
  sine = (Floats<W>)((Ints<W>)choose<W>(odd, c, s) ^ sine_sign);
  cosine = (Floats<W>)((Ints<W>)choose<W>(odd, s, c) ^ cosine_sign);
}

// exp(x) - 1 for -87 <= x <= 87 (beyond: as at the bound), with float32's digits for small x.
template <int W>
HOLO_INLINE Floats<W> expm1(Floats<W> x) {
  x = x < -87.0f ? fill<W>(-87.0f) : x;
  x = x > 87.0f ? fill<W>(87.0f) : x;
  Ints<W> bits;
  const Floats<W> n = nearest<W>(x * 1.44269504f, bits);
  Floats<W> r = fused<W>(n, fill<W>(-0.69287109375f), x);
  r = fused<W>(n, fill<W>(-0.00027608681f), r);
  Floats<W> p = fused<W>(fill<W>(0.00139345445f), r, fill<W>(0.00836377647f));
  p = fused<W>(p, r, fill<W>(0.0416664568f));
  p = fused<W>(p, r, fill<W>(0.166665734f));
  p = fused<W>(p, r, fill<W>(0.5f));
  p = fused<W>(p * r, r, r);
  const Floats<W> power = (Floats<W>)(((Bits<W>)bits << 23) + 0x3f800000u);
  return fused<W>(power, p, power - 1.0f);
}

// exp(log_amplitude - i phase) - 1 = expm1(log_amplitude) - 2 a sin²(phase/2) - i a sin(phase), without cancellation.
template <int W>
HOLO_INLINE Wave<W> exit_wave_minus_one(Floats<W> log_amplitude, Floats<W> phase) {
  Floats<W> sine, cosine;
  sine_cosine<W>(0.5f * phase, sine, cosine);
  const Floats<W> grown = expm1<W>(log_amplitude), twice = (2.0f + 2.0f * grown) * sine;
  return {grown - twice * sine, -twice * cosine};
}

}  // namespace holo
