"""`retrieve`: phase and thickness of single frames, in even and uneven light."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.retrieval import BETA, DELTA, HOLOGRAPHIC, PITCH, K, exposures, gaussian, pixels, taken
from holosplat.optics.background import LightOptions

SHAPE = (81, 105)
MATTER = hs.DeltaBeta(DELTA, BETA)
PEAK = 0.8
"""Phase delay in the middle of the body [rad]."""


def body(views: hs.Views) -> torch.Tensor:
    """Gaussian thickness [m], off the middle, clear of the border."""
    return gaussian(views, PEAK / (K * DELTA), 6.0)


def slopes(shape: tuple[int, int], size: float) -> np.ndarray:
    """Light that changes along both sides, by `size` from the middle to an edge, and is too bright."""
    y, x = (2 * (np.arange(n) + 0.5) / n - 1 for n in shape)
    return 1.02 + size * (0.7 * x + 0.5 * y[:, None] * np.abs(y[:, None]))


@pytest.fixture(scope="module")
def hologram() -> tuple[hs.Exposures, np.ndarray, np.ndarray]:
    """Exposures, the thickness [1, H, W] in metres, and a frame with photon noise, float32."""
    where = exposures(SHAPE, HOLOGRAPHIC)
    thickness, frames = taken(body, where)
    noise = np.random.default_rng(4).normal(scale=0.004, size=(1, *SHAPE))
    return where, thickness.numpy(), (frames.numpy() + noise).astype(np.float32)


def away(found: torch.Tensor, truth: np.ndarray) -> float:
    """Root mean square error over the root mean square."""
    return float(np.linalg.norm(found.numpy() - truth) / np.linalg.norm(truth))


def test_a_body_of_known_profile_comes_back_in_radians_and_metres(hologram):
    where, thickness, frame = hologram
    found = hs.retrieve(frame, where, MATTER)
    assert found.light.background is None
    assert found.thickness.dtype == found.phase.dtype == torch.float32
    assert away(found.thickness, thickness) < 0.06
    assert away(found.phase, -K * DELTA * thickness) < 0.06
    assert float(found.phase.min()) == pytest.approx(-PEAK, rel=0.05)


def test_the_phase_depends_on_the_ratio_alone(hologram):
    where, _, frame = hologram
    found = hs.retrieve(frame, where, MATTER, "paganin").phase
    other = hs.retrieve(frame, where, hs.DeltaBeta(3 * DELTA, 3 * BETA), "paganin").phase
    assert torch.allclose(found, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [0.02, 0.05])
def test_uneven_light_is_divided_out(hologram, size):
    """In even light the same frame would be wrong several times more: the light is a body of its own then."""
    where, thickness, frame = hologram
    light = slopes(SHAPE, size)
    dimmed = (frame * light).astype(np.float32)
    found = hs.retrieve(dimmed, where, MATTER)
    assert found.light.background is not None
    assert found.light.background.factor().numpy()[0] == pytest.approx(light, abs=0.15 * size)
    assert away(found.thickness, thickness) < 0.12
    deaf = hs.retrieve(dimmed, where, MATTER, light=LightOptions("even"))
    assert away(deaf.thickness, thickness) > 2 * away(found.thickness, thickness)
    rows, columns = SHAPE
    beside = ((0, rows, 0, 24), (0, rows, columns - 24, columns))
    told = hs.retrieve(dimmed, where, MATTER, light=LightOptions("smooth", beside))
    assert away(told.thickness, thickness) < 0.12


def test_frames_in_contact_show_what_is_absorbed():
    """Matter that absorbs a tenth: T = -ln I / 2kβ, and the phase by the ratio."""
    where, beta = exposures(SHAPE, 0.0), 20 * BETA
    x, y = pixels(where.views)
    height = 0.1 / (2 * K * beta)
    thickness = height * torch.exp(-0.5 * (x**2 + y**2) / (7 * PITCH) ** 2)
    frame = torch.exp(-2 * K * beta * thickness)[None].float()
    found = hs.retrieve(frame, where, hs.DeltaBeta(DELTA, beta))
    assert away(found.thickness, thickness[None].numpy()) < 0.02
    assert float(found.phase.min()) == pytest.approx(-K * DELTA * height, rel=0.02)


def test_numpy_arrays_of_any_byte_order_are_taken(hologram):
    """float32 arrays are float32, however their file stored them."""
    where, _, frame = hologram
    plain = hs.retrieve(frame, where, MATTER, "paganin").phase
    swapped = hs.retrieve(frame.astype(">f4"), where, MATTER, "paganin").phase
    strided = hs.retrieve(np.asfortranarray(frame), where, MATTER, "paganin").phase
    assert torch.equal(plain, swapped)
    assert torch.equal(plain, strided)


def test_holes_have_a_phase_of_the_opposite_sign(hologram):
    """To first order, which is all that this method sees, the frame of holes is 2 - I, and their phase -φ."""
    where, _, frame = hologram
    bodies, holes = frame.astype(np.float64), 2 - frame.astype(np.float64)
    of_bodies = hs.retrieve(bodies, where, MATTER, "ctf", light=LightOptions("even"))
    of_holes = hs.retrieve(holes, where, hs.DeltaBeta(-DELTA, -BETA), "ctf", light=LightOptions("even"))
    assert torch.allclose(of_holes.phase, -of_bodies.phase, rtol=1e-9, atol=1e-12)
    assert torch.allclose(of_holes.thickness, of_bodies.thickness, rtol=1e-9, atol=1e-18)


def test_bad_requests_are_refused(hologram):
    where, _, frame = hologram
    with pytest.raises(hs.InputError, match=r"method must be one of paganin, .* 'magic'"):
        hs.retrieve(frame, where, MATTER, "magic")
    with pytest.raises(hs.InputError, match="frames must be float32 or float64"):
        hs.retrieve((1000 * frame).astype(np.int32), where, MATTER)
    with pytest.raises(hs.InputError, match="but δ is 0"):
        hs.retrieve(frame, where, hs.DeltaBeta(0.0, BETA))
    with pytest.raises(hs.InputError, match="frames"):
        hs.retrieve(frame[:, :-1], where, MATTER)
    with pytest.raises(hs.InputError, match="no frame shows air"):
        hs.retrieve(frame[:, :20, :30], exposures((20, 30)), MATTER, light=LightOptions("smooth"))
