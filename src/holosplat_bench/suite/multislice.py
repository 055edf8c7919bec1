"""Frames of known matter by a program of its own: numpy and scipy in float64, nothing of holosplat.

It shares no code with what simulates, fits or judges, and takes another way in every step:

- matter: rays pierce triangles, or nested ellipsoids, one ray a sample, and keep the depths at which they do;
- waves: multislice (Cowley & Moodie 1957; Paganin 2006, section 2.7): what lies in a slab of depth changes the wave,
  which then travels to the next by the angular spectrum, without the paraxial approximation (Goodman 2005, eq. 3-74);
- detector: intensity times the transfer functions of a square pixel and of a Gaussian, read at the pixels' centres.

Signs, frames and units are those of docs/conventions.md, which is all that both have in common. Depths count from the
plane through the middle of the object frame, and the distance to the detector begins there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from scipy import constants, fft

TIE = 1.2345e-5
"""Share of a sample by which all rays are shifted, so that none meets an edge of a triangle that lies on the raster."""
LEVELS = 48
"""Ellipsoids by which a soft edge is replaced: its line integrals are then right to about 1e-4."""
CHUNK = 1 << 21
"""Pairs of triangle and sample that are looked at together."""


def wavelength(energy_kev: float) -> float:
    """λ = hc/E [m] of photons of `energy_kev` [keV]."""
    return constants.h * constants.c / (1e3 * energy_kev * constants.e)


@dataclass(frozen=True)
class Raster:
    """Samples of a wave before a detector of `shape` (rows, columns) pixels of `pixel` [m].

    samples: along a pixel's edge; margin: pixels (rows, columns) on each side; shift: of the detector (x, y) [m].
    """

    shape: tuple[int, int]
    pixel: float
    samples: int
    margin: tuple[int, int]
    shift: tuple[float, float] = (0.0, 0.0)

    @property
    def pitch(self) -> float:
        """Distance of samples [m]."""
        return self.pixel / self.samples

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of samples."""
        rows, columns = ((n + 2 * m) * self.samples for n, m in zip(self.shape, self.margin))
        return rows, columns

    @property
    def first(self) -> tuple[float, float]:
        """x and y [m] of the first sample."""
        rows, columns = self.size
        x, y = (0.5 * (1 - n) * self.pitch + s + TIE * self.pitch for n, s in zip((columns, rows), self.shift))
        return x, y

    def frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        """f_y [H, 1] and f_x [1, W] [1/m]."""
        fy, fx = (fft.fftfreq(n, self.pitch) for n in self.size)
        return fy[:, None], fx[None, :]


class Matter(Protocol):
    """What a ray meets."""

    def up_to(self, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """`∫δ dz` and `∫β dz` [m] from far before the object to the plane z = `depth` [m], [H·W] samples."""
        ...


# --- matter ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surfaces:
    """Closed surfaces on a raster: where rays pierce them.

    sample, depth [m], δ and β (above zero where a ray enters): [P] each; count: of the raster's samples.
    """

    count: int
    sample: np.ndarray
    depth: np.ndarray
    delta: np.ndarray
    beta: np.ndarray

    @classmethod
    def of(
        cls,
        meshes: Iterable[tuple[np.ndarray, np.ndarray, float, float]],
        rotation: np.ndarray,
        raster: Raster,
    ) -> Surfaces:
        """meshes: vertices [N, 3] [m], faces [M, 3] (outward), δ and β of each; rotation: lab from object, [3, 3]."""
        parts = []
        for vertices, faces, delta, beta in meshes:
            sample, depth, enters = _pierced((vertices @ rotation.T)[faces], raster)
            if np.bincount(sample, enters).any():
                raise ValueError("a ray enters a surface without leaving it; the mesh must be closed.")
            parts.append((sample, depth, delta * enters, beta * enters))
        rows, columns = raster.size
        return cls(rows * columns, *(np.concatenate(p) for p in zip(*parts)))

    def up_to(self, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """What lies before a plane: each crossing counts with the way from it to the plane."""
        way = np.maximum(depth - self.depth, 0)
        delta, beta = (np.bincount(self.sample, n * way, self.count) for n in (self.delta, self.beta))
        return delta, beta


def _pierced(corners: np.ndarray, raster: Raster) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples, depths [m] and ±1 (entering, leaving) at which rays along z pierce triangles `corners` [M, 3, 3] [m]."""
    plane = (corners[..., :2] - raster.first) / raster.pitch  # x, y in samples
    rows, columns = raster.size
    low = np.clip(np.ceil(plane.min(1)).astype(np.int64), 0, None)
    high = np.minimum(np.floor(plane.max(1)).astype(np.int64), (columns - 1, rows - 1))
    wide, tall = np.maximum(high - low + 1, 0).T
    found = [(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))]
    ends = np.cumsum(wide * tall)
    for start, stop in _chunks(ends):
        count = (wide * tall)[start:stop]
        triangle = np.repeat(np.arange(start, stop), count)
        inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        j, i = low[triangle, 0] + inside % wide[triangle], low[triangle, 1] + inside // wide[triangle]
        found.append(_inside(triangle, j, i, plane, corners[..., 2], columns))
    sample, depth, enters = (np.concatenate(parts) for parts in zip(*found))
    return sample, depth, enters


def _chunks(ends: np.ndarray) -> Iterable[tuple[int, int]]:
    """Ranges of triangles whose samples are `CHUNK` or so together."""
    start, done = 0, 0
    while start < len(ends):
        stop = max(start + 1, int(np.searchsorted(ends, done + CHUNK)))
        yield start, stop
        start, done = stop, int(ends[stop - 1])


def _inside(
    triangle: np.ndarray, j: np.ndarray, i: np.ndarray, plane: np.ndarray, z: np.ndarray, columns: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of candidates those whose sample lies in their triangle: by barycentric coordinates."""
    (ax, ay), (bx, by), (cx, cy) = (plane[triangle, n].T for n in range(3))
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((j - ax) * (cy - ay) - (cx - ax) * (i - ay)) / area
        v = ((bx - ax) * (i - ay) - (j - ax) * (by - ay)) / area
    hit = (u > 0) & (v > 0) & (u + v < 1)
    t, u, v = triangle[hit], u[hit], v[hit]
    depth = z[t, 0] + u * (z[t, 1] - z[t, 0]) + v * (z[t, 2] - z[t, 0])
    return i[hit] * columns + j[hit], depth, -np.sign(area[hit])  # an outward normal against the beam enters


@dataclass(frozen=True)
class Ellipsoids:
    """Ellipsoids of matter that falls outwards, on a raster: chords of nested sharp ones.

    box: flat samples [P]; near, far: z [m] of the chord's ends, P; delta, beta: at its points, of z [m] from the origin
    `n (flat + slope z)`; lists of one for each sharp ellipsoid.
    """

    count: int
    chords: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, tuple[float, float]]]

    @classmethod
    def of(cls, elements: Iterable[Any], rotation: np.ndarray, raster: Raster) -> Ellipsoids:
        """elements: with centre, semi-axes in the rows of axes, gradient [1/m], matter (δ, β), profile: all read only.

        Of a profile only its definition `density(s²)` and the s where it begins to fall and ends are used.
        """
        chords = []
        for element in elements:
            profile = element.profile
            edges = np.linspace(profile.core, profile.reach, LEVELS + 1) if profile.reach > profile.core else []
            middles = [0.5 * (a + b) for a, b in pairwise(edges)] or [profile.reach]
            at = profile.density(np.square(edges)) if len(edges) else np.array([1.0, 0.0])
            for size, share in zip(middles, at[:-1] - at[1:]):
                chords.append(_chord(element, rotation, raster, size, share))
        rows, columns = raster.size
        return cls(rows * columns, chords)

    def up_to(self, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """What lies before a plane, of every ellipsoid with its linear gradient along the ray."""
        delta, beta = np.zeros(self.count), np.zeros(self.count)
        for sample, near, far, flat, slope, (of_delta, of_beta) in self.chords:
            end = np.clip(depth, near, far)
            way = (end - near) * (flat + 0.5 * slope * (near + end))
            delta[sample] += of_delta * way
            beta[sample] += of_beta * way
        return delta, beta


def _chord(
    element: Any, rotation: np.ndarray, raster: Raster, size: float, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, tuple[float, float]]:
    """The chords of one sharp ellipsoid, `size` times the element's semi-axes, with `share` of its matter."""
    axes, centre = size * element.axes @ rotation.T, rotation @ element.centre
    form = axes.T @ np.diag(np.square(axes).sum(1) ** -2) @ axes  # r' F r = 1 on the surface
    gradient = rotation @ element.gradient
    (x0, y0), pitch, (rows, columns) = raster.first, raster.pitch, raster.size
    half = np.sqrt(np.diag(np.linalg.inv(form)))
    (left, right), (top, bottom) = (
        np.clip(np.ceil((c + np.array([-h, h]) - first) / pitch).astype(int), 0, n)
        for c, h, first, n in zip(centre, half, (x0, y0), (columns, rows))
    )
    x = (x0 + pitch * np.arange(left, right) - centre[0])[None, :]
    y = (y0 + pitch * np.arange(top, bottom) - centre[1])[:, None]
    c = form[0, 0] * x * x + 2 * form[0, 1] * x * y + form[1, 1] * y * y - 1
    b = form[0, 2] * x + form[1, 2] * y
    root = b * b - form[2, 2] * c
    hit = root > 0
    middle, reach = (-b[hit] / form[2, 2], np.sqrt(root[hit]) / form[2, 2])
    flat = (1 + gradient[0] * x + gradient[1] * y)[hit] - gradient[2] * centre[2]
    sample = (np.arange(top, bottom)[:, None] * columns + np.arange(left, right)[None, :])[hit]
    middle = middle + centre[2]
    of_matter = share * element.matter[0], share * element.matter[1]
    return sample, middle - reach, middle + reach, flat, float(gradient[2]), of_matter


# --- waves and detector ---------------------------------------------------------------------------------------


def travel(wave: np.ndarray, way: float, energy_kev: float, raster: Raster) -> np.ndarray:
    """`wave` [H, W] after `way` [m] of free space, without the constant `exp(ikz)`: the angular spectrum."""
    if way == 0:
        return wave
    fy, fx = raster.frequencies()
    square, largest = fy * fy + fx * fx, 1 / wavelength(energy_kev)
    spectrum = np.asarray(fft.fft2(wave))
    # kz - k = 2π (√(1/λ² - f²) - 1/λ), written so that no digits cancel; waves beyond 1/λ do not travel
    turns = -square / (largest + np.sqrt(np.maximum(largest**2 - square, 0)))
    spectrum *= np.exp(2j * np.pi * way * turns) * (square < largest**2)
    return np.asarray(fft.ifft2(spectrum))


def behind(matter: Matter, slabs: Sequence[float], energy_kev: float, raster: Raster) -> np.ndarray:
    """The wave [H, W] behind the object, brought back to the plane z = 0, where the distance begins.

    slabs: depths [m] of the planes between slabs, the first before and the last behind all matter. What is in a slab
    acts in its middle.
    """
    k = 2 * np.pi / wavelength(energy_kev)
    wave, at = np.ones(raster.size, complex), 0.0
    before = matter.up_to(slabs[0])
    for near, far in pairwise(slabs):
        after = matter.up_to(far)
        middle = 0.5 * (near + far)
        wave = travel(wave, middle - at, energy_kev, raster)
        delta, beta = (b - a for a, b in zip(before, after))
        wave *= np.exp(-k * beta - 1j * k * delta).reshape(raster.size)
        before, at = after, middle
    return travel(wave, -at, energy_kev, raster)


def frame(wave: np.ndarray, distance: float, energy_kev: float, psf_px: float, raster: Raster) -> np.ndarray:
    """The frame [h, w] of a `wave` [H, W] that leaves z = 0: means of the blurred intensity over pixels."""
    seen = travel(wave, distance, energy_kev, raster)
    spectrum = np.asarray(fft.fft2(np.real(seen) ** 2 + np.imag(seen) ** 2))
    fy, fx = raster.frequencies()
    to_the_middle = 0.5 * (raster.samples - 1) * raster.pitch
    for f in (fy, fx):
        spectrum *= np.sinc(f * raster.pixel) * np.exp(-2 * (np.pi * f * psf_px * raster.pixel) ** 2)
        spectrum *= np.exp(2j * np.pi * f * to_the_middle)
    rows, columns = (slice(m * raster.samples, (m + n) * raster.samples, raster.samples)
                     for m, n in zip(raster.margin, raster.shape))  # fmt: skip
    return np.real(np.asarray(fft.ifft2(spectrum)))[rows, columns]


def sampled(wave: np.ndarray, distance: float, energy_kev: float, psf_px: float, raster: Raster) -> np.ndarray:
    """As `frame`, but each pixel is the plain mean of its samples: for comparisons on one and the same raster."""
    seen = travel(wave, distance, energy_kev, raster)
    spectrum = np.asarray(fft.fft2(np.abs(seen) ** 2))
    for f in raster.frequencies():
        spectrum *= np.exp(-2 * (np.pi * f * psf_px * raster.pixel) ** 2)
    return pixels(np.real(np.asarray(fft.ifft2(spectrum))), raster)


def pixels(samples: np.ndarray, raster: Raster) -> np.ndarray:
    """Means [h, w] of samples [H, W] over the pixels of the detector."""
    (h, w), (my, mx), s = raster.shape, raster.margin, raster.samples
    return samples[my * s : (my + h) * s, mx * s : (mx + w) * s].reshape(h, s, w, s).mean((1, 3))
