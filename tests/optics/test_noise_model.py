"""The noise of frames by their air: white, and correlated grain; fringes are no noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from holosplat.checks import InputError
from holosplat.optics.air import air_in_boxes, find_air, has_air
from holosplat.optics.noise import NoiseModel

SHAPES = [(4, 96, 96), (4, 81, 117)]


def white(shape: tuple[int, ...], sigma: float, seed: int = 0) -> np.ndarray:
    return sigma * np.random.default_rng(seed).normal(size=shape)


def grain(shape: tuple[int, ...], sigma: float, width: float, seed: int = 1) -> np.ndarray:
    """Noise blurred by a Gaussian of `width` pixels, of standard deviation `sigma`."""
    noise = np.random.default_rng(seed).normal(size=shape)
    blurred = np.stack([gaussian_filter(image, width, mode="wrap") for image in noise])
    return sigma * blurred / blurred.std()


def grain_power(shape: tuple[int, ...], sigma: float, width: float) -> np.ndarray:
    """Its power at the frequencies of rfft2: a Gaussian whose sum over all frequencies is the variance."""
    squared = np.fft.fftfreq(shape[1])[:, None] ** 2 + np.fft.rfftfreq(shape[2]) ** 2
    return sigma**2 * 4 * np.pi * width**2 * np.exp(-4 * np.pi**2 * width**2 * squared)


def rings(shape: tuple[int, int], radius: float = 9.0, height: float = 0.2, chirp: float = 0.15) -> np.ndarray:
    """The fringes of a ball near the middle: they fade away from its edge and become finer."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    out = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2 - 3) - radius
    return height * np.cos(chirp * out * np.abs(out)) * np.exp(-((out / 7) ** 2))


def tensor(frames: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(frames)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_white_noise_has_its_deviation_and_no_grain(shape, sigma):
    found = NoiseModel.of_frames(tensor(1 + white(shape, sigma)))
    assert found.white.numpy() == pytest.approx(sigma, rel=0.08)
    assert not found.has_grain
    assert found.power().shape == (shape[0], shape[1], shape[2] // 2 + 1)
    assert found.level.numpy() == pytest.approx(found.white.numpy())


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [1.0, 1.6])
def test_grain_has_its_spectrum(shape, width):
    frames = 1 + white(shape, 0.01) + grain(shape, 0.01, width)
    found = NoiseModel.of_frames(tensor(frames), correlated=True)
    assert not NoiseModel.of_frames(tensor(frames)).has_grain  # nothing is correlated where nobody has asked
    assert found.white.numpy() == pytest.approx(0.01, rel=0.1)
    assert found.level.numpy() == pytest.approx(0.01 * 2**0.5, rel=0.08)
    wanted = grain_power(shape, 0.01, width)
    band = (wanted < 0.6 * wanted.max()) & (wanted > 0.1 * wanted.max())
    assert found.grain[0].numpy()[band].mean() == pytest.approx(wanted[band].mean(), rel=0.25)
    assert found.grain[0, 1:4, 1:4].mean().item() == pytest.approx(wanted[1:4, 1:4].mean(), rel=0.45)


@pytest.mark.parametrize("shape", SHAPES)
def test_fringes_are_no_noise(shape):
    clean = np.stack([1 + rings(shape[1:], height=h) for h in (0.1, 0.2, 0.3, 0.4)])
    found = NoiseModel.of_frames(tensor(clean))
    assert found.level.max() < 0.01 * (clean - 1).std()
    noisy = NoiseModel.of_frames(tensor(clean + white(shape, 0.02)))
    assert noisy.white.numpy() == pytest.approx(0.02, rel=0.1)
    assert not noisy.has_grain
    filled = np.stack([1 + rings(shape[1:], 60.0, h, 0.3) + rings(shape[1:], 30.0, h, 0.3) for h in (0.1, 0.2)])
    assert NoiseModel.of_frames(tensor(filled)).level.max() < 0.1 * (filled - 1).std()


def test_grain_beside_fringes_and_slow_light_is_that_of_the_air():
    shape = SHAPES[1]
    slow = 1 + 0.03 * np.linspace(-1, 1, shape[2]) + 0.02 * np.cos(np.linspace(0, 3, shape[1]))[:, None]
    frames = slow * (1 + rings(shape[1:])) * (1 + grain(shape, 0.01, 1.3)) + white(shape, 0.01)
    found = NoiseModel.of_frames(tensor(frames), correlated=True)
    assert found.level.numpy() == pytest.approx(0.01 * 2**0.5, rel=0.12)
    air = air_in_boxes([(0, 81, 0, 25), (0, 81, 95, 117)], 4, (81, 117))
    given = NoiseModel.of_frames(tensor(frames), air, correlated=True)
    assert given.level.numpy() == pytest.approx(found.level.numpy(), rel=0.1)


@pytest.mark.parametrize("shape", SHAPES)
def test_noise_beside_a_prediction_needs_no_air(shape):
    """Fringes fill the frames, and what predicts them leaves the noise."""
    matter = 1 + rings(shape[1:], 60.0, 0.2, 0.3)
    frames = matter * (1 + white(shape, 0.01) + grain(shape, 0.01, 1.3))
    found = NoiseModel.of_residuals(tensor(frames), tensor(np.broadcast_to(matter, shape).copy()))
    assert found.white.numpy() == pytest.approx(0.01, rel=0.15)
    assert found.level.numpy() == pytest.approx(0.01 * 2**0.5, rel=0.1)


def test_power_on_another_raster_is_that_of_the_same_frequency():
    shape = (2, 81, 117)
    power = grain_power(shape, 0.01, 1.5)
    model = NoiseModel(torch.full((2,), 0.01).double(), tensor(np.stack([power, 2 * power])), 117)
    same = model.power_on((81, 117))
    assert same.numpy() == pytest.approx(model.power().numpy(), rel=1e-12)
    wide = model.power_on((150, 200))[1].numpy() - 1e-4
    assert wide == pytest.approx(2 * grain_power((1, 150, 200), 0.01, 1.5), abs=0.01 * 2 * power.max())
    fine = model.power_on((162, 234), 2)[0].numpy() - 1e-4
    assert fine[:20, :30] == pytest.approx(power[:20, :30], rel=1e-4)
    assert fine[81, :] == pytest.approx(0, abs=1e-9)
    assert len(model[torch.tensor([1])]) == 1


def test_shapes_must_agree():
    with pytest.raises(InputError, match="white noise"):
        NoiseModel(torch.zeros(3), torch.zeros(2, 5, 3))


@pytest.mark.parametrize("shape", SHAPES)
def test_air_is_the_quiet_bright_part_at_the_sides(shape):
    slow = 0.7 * (1 + 0.03 * np.linspace(-1, 1, shape[2]))
    frames = slow * (1 + rings(shape[1:])) + white(shape, 0.01)
    rows, columns = np.mgrid[: shape[1], : shape[2]]
    out = np.hypot(rows - shape[1] / 2, columns - shape[2] / 2 - 3)
    frames[:, out < 6] *= 0.9  # the quiet inside of a body
    air = find_air(tensor(frames)).numpy()
    assert air.dtype == bool
    assert not air[:, out < 14].any()
    assert air[:, out > 30].mean() > 0.9
    assert has_air(tensor(air)).all()


def test_a_dark_body_at_the_side_is_no_air_and_a_crowded_frame_has_none():
    frames = 1 + white((1, 64, 90), 0.01)
    frames[:, :, 60:] *= 0.5
    air = find_air(tensor(frames))
    assert float(air[:, :, 70:].double().mean()) == 0
    assert float(air[:, :, :50].double().mean()) > 0.9
    columns = np.arange(90)
    crowded = 1 + 0.2 * np.cos(2 * np.pi * columns / 9) + white((1, 64, 90), 0.002)
    crowded[:, 20:44, 30:60] = 1 + white((24, 30), 0.002)  # quiet, but in the middle
    assert not find_air(tensor(crowded)).any()
    assert not find_air(torch.zeros(1, 20, 20)).any()
    assert not find_air(torch.ones(1, 2, 20)).any()
    assert not find_air(torch.ones(1, 7, 10)).any()


def test_frames_whose_last_column_alone_is_quiet_are_no_error():
    """The finest wavelets have no value there."""
    frame = np.array([1.05, 0.63, 0.54, 0.77, 1.11])[None].repeat(201, 0)
    assert not find_air(tensor(frame[None])).any()


@pytest.mark.parametrize("shape", [(64, 64), (45, 71)])
def test_fringes_in_air_without_any_noise_are_neither_air_nor_noise(shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    edge = np.exp(-0.5 * (np.hypot(y - 22, x - 30) - 9) ** 2)
    frame = torch.from_numpy(1 + np.where(edge > 1e-4, 0.05 * edge * np.cos(3 * edge), 0.0))[None]

    air = find_air(frame)[0]

    assert not air[frame[0] != 1].any()
    assert float(air.float().mean()) > 0.2
    assert float(NoiseModel.of_frames(frame).white) < 1e-6


@pytest.mark.parametrize("box", [(0, 0, 0, 5), (0, 5, 3, 40), (-1, 5, 0, 5)])
def test_boxes_must_lie_in_the_frame(box):
    with pytest.raises(InputError, match="--air"):
        air_in_boxes([box], 2, (20, 30))


def test_boxes_are_joined():
    air = air_in_boxes([(0, 5, 0, 4), (10, 20, 26, 30)], 3, (20, 30))
    assert air.shape == (3, 20, 30)
    assert int(air.sum()) == 3 * (20 + 40)
    with pytest.raises(InputError, match="at least one"):
        air_in_boxes([], 1, (5, 5))


def test_draws_have_the_power_of_the_noise():
    shape, smooth = (9, 14), torch.linspace(1.0, 0.0, 8, dtype=torch.float64) ** 2
    known = NoiseModel(torch.full((400,), 0.1, dtype=torch.float64), 0.04 * smooth.expand(400, 9, 8), 14)
    spectra = torch.fft.rfft2(known.drawn(3), norm="ortho").abs().square().mean(dim=0)
    np.testing.assert_allclose(spectra.mean(dim=0).numpy(), known.power()[0].mean(dim=0).numpy(), rtol=0.1)
    assert known.drawn(3).shape == (400, *shape)
    assert torch.equal(known.drawn(3), known.drawn(3))
