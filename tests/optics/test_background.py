"""Uneven light: found in air, and beside what matter predicts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from holosplat.beamline.light import correlated_field
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.frames import binned
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.model import SolvedLight
from holosplat.optics.background import Background, Light, LightOptions
from holosplat.optics.noise import NoiseModel
from holosplat.scan import Exposures
from holosplat_bench.specimens.soft_matter import round_cell

SHAPES = [(5, 72, 72), (4, 61, 90)]


def rings(shape: tuple[int, int]) -> np.ndarray:
    """A faint ball with fringes about its edge, in the middle."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    out = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2) - 12
    return 1 + 0.15 * np.cos(0.1 * out * np.abs(out)) * np.exp(-((out / 4) ** 2)) - 0.01 * (out < 0)


def uneven(shape: tuple[int, ...], kind: str, size: float = 0.02, seed: int = 3) -> np.ndarray:
    """Smooth factors of rms `size` about one: slopes, blurred noise, or a bump."""
    draw, light = np.random.default_rng(seed), []
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape[1:]), indexing="ij")
    for _ in range(shape[0]):
        if kind == "slopes":
            field = draw.normal() + draw.normal() * rows + draw.normal() * columns
        elif kind == "clouds":
            edge = min(shape[1:])
            wide = gaussian_filter(draw.normal(size=(3 * shape[1], 3 * shape[2])), edge / 4)
            field = wide[shape[1] : 2 * shape[1], shape[2] : 2 * shape[2]]
        else:
            field = np.exp(-((rows - draw.uniform(-1, 1)) ** 2 + (columns - draw.uniform(-1, 1)) ** 2))
        light.append(1 + size * field / np.sqrt((field**2).mean()))
    return np.stack(light)


def measured(shape: tuple[int, ...], light: np.ndarray, noise: float = 0.01) -> torch.Tensor:
    clean = np.stack([rings(shape[1:])] * shape[0]) * light
    return torch.from_numpy((clean + noise * np.random.default_rng(0).normal(size=shape)).astype(np.float32))


def rms(values: np.ndarray | torch.Tensor) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


@pytest.mark.parametrize("shape", SHAPES)
def test_even_light_stays_as_it_is(shape):
    for noise in (0.0, 0.01):
        frames = measured(shape, np.ones(shape), noise)
        found = Light.of(frames)
        assert found.background is None
        assert found.evened(frames) is frames


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", ["slopes", "clouds", "bump"])
def test_light_is_found_in_air_and_where_matter_is(shape, kind):
    light = uneven(shape, kind)
    frames = measured(shape, light)
    found = Light.of(frames)
    assert found.background is not None
    off, air = found.background.factor().numpy() - light, found.air.numpy()
    assert rms(off[air]) < 0.15 * rms(light - 1)
    assert rms(off[~air]) < 0.4 * rms(light - 1)
    assert rms(found.evened(frames)[found.air] - 1) == pytest.approx(0.01, rel=0.12)
    assert Light.of(frames, LightOptions("even")).background is None


@pytest.mark.parametrize("shape", SHAPES)
def test_light_that_is_faint_beside_the_contrast_is_uneven_where_air_is_sure(shape):
    """Of a twentieth of the contrast: seen in little noise, and not in much."""
    size = 0.05 * rms(measured(shape, np.ones(shape), 0.0) - 1)
    for noise, seen in ((0.2 * size, True), (5 * size, False)):
        found = Light.of(measured(shape, uneven(shape, "slopes", size), noise))
        assert (found.background is not None) is seen


@pytest.mark.parametrize("shape", [(6, 84, 92), (4, 61, 98)])
@pytest.mark.parametrize("kind", ["slopes", "correlated"])
def test_light_without_noise_does_not_run_away_where_there_is_no_air(shape, kind):
    """What the modes leave of it would, if it passed for known to the last digit."""
    draw = np.random.default_rng(4)
    light = uneven(shape, kind) if kind == "slopes" else np.stack([correlated_field(shape[1:], 40, draw)] * shape[0])
    light = light if kind == "slopes" else 1 + 0.02 * light
    frames = torch.from_numpy(light.astype(np.float32))
    rows, columns = np.mgrid[: shape[1], : shape[2]]
    inside = torch.from_numpy(np.hypot(rows / shape[1] - 0.5, columns / shape[2] - 0.5) < 0.4)
    air = (~inside).expand(shape).clone()
    found = Background.of_air(frames, air, NoiseModel.of_frames(frames, air)).factor().numpy()
    assert rms((found - light)[:, inside]) < 0.5 * rms(light - 1)


@pytest.mark.parametrize("shape", SHAPES)
def test_matter_that_is_known_leaves_the_light_and_no_more(shape):
    """The coefficients that a fit solves for are those beside the frames that matter predicts."""
    light = uneven(shape, "clouds")
    frames = measured(shape, light)
    found = Light.of(frames)
    assert found.background is not None
    truth = torch.from_numpy(np.stack([rings(shape[1:])] * shape[0])).float()
    left = SolvedLight(found.background, found.evened(frames)).factor(images=truth)
    whole = left.double() * found.background.factor()
    assert rms(whole.numpy() - light) < 0.15 * rms(light - 1)
    settled = found.settled(frames, truth).background
    assert settled is not None
    assert settled.factor().numpy() == pytest.approx(whole.numpy(), abs=2e-4)
    field = SolvedLight(found.background, found.evened(frames)).settled(truth)
    assert torch.allclose(field.factor(), left, atol=1e-6)
    some = SolvedLight(found.background, found.evened(frames)).factor(torch.tensor([2, 0]), truth[[2, 0]])
    assert torch.allclose(some, left[[2, 0]])
    assert SolvedLight(found.background, frames).factor().eq(1).all()


def test_what_is_unknown_is_slow_and_where_there_is_no_air():
    shape = SHAPES[1]
    found = Light.of(measured(shape, uneven(shape, "clouds")))
    more = found.doubt.power() - found.noise.power()
    assert float(more.min()) >= 0
    assert float(more[0, 0, 0]) > 10 * float(more[0, 20, 20])


@pytest.mark.parametrize("shape", SHAPES)
def test_steep_light_is_not_taken_for_grain(shape):
    """Noise is what is left when light is divided out; what passes for grain hides the light that is left."""
    draw = np.random.default_rng(1)
    light = 1 + 0.03 * np.stack([correlated_field(shape[1:], 12.0, draw) for _ in range(shape[0])])
    frames = measured(shape, light, 0.007)
    found = Light.of(frames, LightOptions(air=((0, shape[1], 0, 18), (0, shape[1], shape[2] - 18, shape[2]))))
    assert found.background is not None
    before = NoiseModel.of_frames(frames, found.air, correlated=True)
    assert found.noise.grain_level < 0.5 * before.grain_level
    assert rms((found.background.factor().numpy() - light)[found.air.numpy()]) < 0.28 * 0.007


@pytest.mark.parametrize("shape", SHAPES)
def test_matter_that_is_predicted_in_air_does_not_change_the_light(shape):
    frames = measured(shape, uneven(shape, "clouds"))
    found = Light.of(frames)
    assert found.background is not None
    truth = torch.from_numpy(np.stack([rings(shape[1:])] * shape[0])).float()
    truth = torch.where(found.air, 1.0, truth)
    hazy = torch.where(found.air, 0.98, truth)
    evened = found.evened(frames)
    solved = SolvedLight(found.background, evened, found.air)
    assert torch.equal(solved.factor(images=hazy), solved.factor(images=truth))
    assert not torch.equal(SolvedLight(found.background, evened).factor(images=hazy), solved.factor(images=truth))
    light, beside = found.settled(frames, hazy), found.settled(frames, truth)
    assert light.background is not None
    assert beside.background is not None
    assert torch.equal(light.background.coefficients, beside.background.coefficients)
    assert light.misfit(frames, truth) < 0.8 * light.misfit(frames, hazy)


@pytest.mark.parametrize("factor", [1, 2, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_light_of_some_binned_frames_is_that_of_all(shape, factor):
    frames = measured(shape, uneven(shape, "clouds"))
    found = Light.of(frames)
    part = found.part(torch.tensor([3, 1]), factor)
    assert found.background is not None
    assert part.background is not None
    want = torch.from_numpy(binned(found.background.factor().numpy(), factor))[[3, 1]]
    assert part.background.factor().numpy() == pytest.approx(want.numpy(), abs=3e-4)
    assert part.air.shape == want.shape
    assert part.air.equal(torch.from_numpy(binned(found.air.double().numpy(), factor) > 0.999)[[3, 1]])
    assert part.noise.white.numpy() == pytest.approx(found.noise.white[[3, 1]].numpy() / factor)
    doubts = (one.background.covariances.diagonal(dim1=1, dim2=2).sum(dim=1) for one in (part, found) if one.background)
    ours, whole = doubts
    assert ours.numpy() == pytest.approx(whole[[3, 1]].numpy(), rel=0.1)


def test_light_given_by_boxes_and_in_vain():
    shape = (2, 40, 50)
    rows, columns = np.mgrid[:40, :50]
    crowded = 1 + 0.2 * np.cos(2 * np.pi * columns / 9 + rows) * np.ones(shape)
    frames = torch.from_numpy(crowded)
    with pytest.raises(InputError, match="--air"):
        Light.of(frames, LightOptions("smooth"))
    assert Light.of(frames).background is None
    frames[:, :, :12] = 1.05
    found = Light.of(frames, LightOptions("smooth", ((0, 40, 0, 12),)))
    assert found.background is not None
    assert found.background.factor()[:, :, :12].numpy() == pytest.approx(1.05, abs=0.002)
    with pytest.raises(InputError, match="kind must be one of auto, even, smooth"):
        LightOptions("dim")  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def round_cell_frames() -> torch.Tensor:
    """A smooth cell that nearly fills small frames, without noise."""
    exposures = Exposures.of(Views.evenly_spaced(12, (37, 40), 1e-6), 20.0, 0.03)
    cell = round_cell(30e-6, DeltaBeta(3e-7, 2e-10), seed=10)
    return torch.from_numpy(simulate(cell, exposures, is_test=np.zeros(12, dtype=bool)).frames)


def test_a_body_whose_edge_noise_hides_is_not_light(round_cell_frames):
    """Its shadow passes for air, and is uneven; at the left and right of the frames it is not. In the whole air it was
    found uneven in 19 of 20."""
    contrast, found = float((round_cell_frames - 1).square().mean().sqrt()), 0
    for seed in range(20):
        noise = contrast * np.random.default_rng(seed).normal(size=round_cell_frames.shape)
        light = Light.of(round_cell_frames + torch.from_numpy(noise).float())
        found += light.background is not None or light.noise.has_grain
    assert found <= 1


def test_true_light_on_small_noisy_frames_is_found(round_cell_frames):
    for seed in range(6):
        light = torch.from_numpy(uneven(tuple(round_cell_frames.shape), "clouds", 0.02, seed))
        noise = 5000**-0.5 * np.random.default_rng(seed).normal(size=light.shape)
        assert Light.of((round_cell_frames * light + torch.from_numpy(noise)).float()).background is not None
