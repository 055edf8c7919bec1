"""What hypothesis draws for the tests of properties: poses, frames, scans and clouds."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.geometry import Views
from holosplat.scan import Exposures, Scan

LETTERS = st.characters(exclude_categories=["Cs", "Cc"])
ESCAPES = st.sampled_from(["%2F", "%25", "%", "/", ".", "a"])
NAMES = st.text(LETTERS, min_size=1, max_size=12) | st.lists(ESCAPES, min_size=1, max_size=3).map("".join)
"""Texts with letters of any script, without control characters; often of what escapes and paths are made of."""


def numbers(low: float, high: float, width: int = 64) -> st.SearchStrategy[float]:
    """Floating-point numbers of `width` bits between `low` and `high`."""
    low, high = (float(np.float32(v)) if width == 32 else v for v in (low, high))
    return st.floats(low, high, width=width, allow_subnormal=False)


def vectors(low: float, high: float, *shape: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays of `shape`, float64, each entry between `low` and `high` and drawn for itself."""
    return arrays(np.float64, shape, elements=numbers(low, high), fill=st.nothing())


def rotations(count: int) -> st.SearchStrategy[np.ndarray]:
    """Rotation matrices [count, 3, 3] in all directions, also the identity."""
    return vectors(-np.pi, np.pi, count, 3).map(lambda v: Rotation.from_rotvec(v).as_matrix())


@st.composite
def images(draw: st.DrawFn, least: int = 2, most: int = 24, low: float = 0.0, high: float = 2.0) -> np.ndarray:
    """An image [H, W] of random numbers between `low` and `high`, its sides drawn apart, float64."""
    shape = draw(st.tuples(st.integers(least, most), st.integers(least, most)))
    return np.random.default_rng(draw(st.integers(0, 2**32 - 1))).uniform(low, high, shape)


@st.composite
def views(draw: st.DrawFn, most: int = 4, shift_px: float = 3.0) -> Views:
    """Up to `most` views in any pose on a rectangular raster."""
    count, shape = draw(st.integers(1, most)), draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    pixel = draw(numbers(1e-7, 1e-4))
    shifts = pixel * draw(vectors(-shift_px, shift_px, count, 2))
    return Views(draw(rotations(count)), shifts, shape, pixel)


VIEWS = views()
"""What `scans` draws its poses from, where nothing else is asked."""


@st.composite
def scans(draw: st.DrawFn, poses: st.SearchStrategy[Views] = VIEWS) -> Scan:
    """A scan of frames of any finite values: distances, blurs, times and texts are drawn frame by frame."""
    seen = draw(poses)
    count = len(seen)
    several = (draw(vectors(*bounds, count)) for bounds in ((1e-6, 100.0), (0.0, 4.0), (0.0, 1e3)))
    exposures = Exposures(seen, draw(numbers(0.2, 500.0)), *several)
    low, high = -10.0, 1e4
    frames = draw(arrays(np.float32, (count, *seen.shape), elements=numbers(low, high, 32)))
    is_test = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    return Scan(frames, exposures, is_test, draw(st.dictionaries(NAMES, NAMES, max_size=3)))


@st.composite
def clouds(draw: st.DrawFn, reach: float = 6.0, most: int = 5, channels: int = 2) -> list[Tensor]:
    """Centres within `reach` pixels of the middle, scales of 0.8 to 3 pixels, turns, signed amplitudes; float32."""
    count = draw(st.integers(1, most))
    centres, scales = draw(vectors(-reach, reach, count, 3)), draw(vectors(0.8, 3.0, count, 3))
    quaternions = np.roll(Rotation.from_matrix(draw(rotations(count))).as_quat(), 1, axis=1)
    amplitudes = draw(vectors(-2.0, 2.0, count, channels))
    return [torch.from_numpy(a).float().contiguous() for a in (centres, scales, quaternions, amplitudes)]
