"""Objects that say themselves what frames show: closed forms, seeds, files, gradients, and their place in the model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.io.objects import read_object, write_object
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.representations import random_cloud
from holosplat.scan import Exposures
from holosplat_bench.opponents.fields import Encoding, Network
from holosplat_bench.opponents.photographed import AlphaCloud, RadianceField

PIXEL, SHAPE = 2e-6, (7, 11)
VIEWS = Views.from_angles([0.0, 50.0, 130.0], SHAPE, PIXEL)
FRAMES = torch.linspace(0.4, 1.9, 3 * 7 * 11).reshape(3, *SHAPE)
MATTER = Matter.one(1e-7, 1e-10)
SMALL = Network(Encoding(kind="octaves", finest=3.0), hidden=6, layers=1)


def cloud(seed: int = 0) -> AlphaCloud:
    return AlphaCloud.random(20, VIEWS, FRAMES, MATTER, seed)


def field(seed: int = 0) -> RadianceField:
    return RadianceField.filling(Grid.of_views(VIEWS), FRAMES, MATTER, SMALL, seed)


@pytest.mark.parametrize("make", [cloud, field])
def test_a_random_start_is_that_of_its_seed(make):
    one, again, other = (make(seed).photographs(VIEWS) for seed in (1, 1, 2))
    assert torch.equal(one, again)
    assert not torch.allclose(one, other)


def test_greys_at_the_start_are_those_of_pixels():
    few = torch.tensor([[[0.4, 1.0], [1.3, 1.9]]])
    start = AlphaCloud.random(200, VIEWS, few, MATTER, 0)
    low, high = start.greys
    greys = low + (high - low) * torch.sigmoid(start.raw_greys)
    assert all(float((greys - value).abs().min()) < 0.02 for value in few.flatten())
    assert float((greys[..., None] - few.flatten()).abs().amin(-1).max()) < 0.02


@pytest.mark.parametrize("make", [cloud, field])
def test_files_hold_them(make, tmp_path: Path):
    written = make().made_of(Matter.one(3e-7, 1e-10))
    write_object(tmp_path / "object.h5", written)
    read = read_object(tmp_path / "object.h5")
    assert isinstance(read, type(written))
    assert read.matter == written.matter
    assert torch.equal(read.photographs(VIEWS), written.photographs(VIEWS))
    with pytest.raises(InputError, match="greys must be the darkest"):
        type(written).from_state(written.state() | {"greys": [1.0, 1.0]})


@pytest.mark.parametrize("make", [cloud, field])
def test_frames_of_a_model_are_photographs(make):
    """Wherever the detector is and whatever it blurs; on pixels of another size, those of the same lengths."""
    seen = make()
    far = Exposures.of(VIEWS, 20.0, 0.3)
    index = torch.tensor([2, 0])
    model = Model(seen, Instrument(replace(far, psf_sigma_px=far.psf_sigma_px + 1), 2))
    assert not model.by_waves
    assert torch.equal(model.frames(index), seen.photographs(VIEWS[[2, 0]]))
    coarse = Views.of_pixels(VIEWS.rotations[:1], VIEWS.shifts[:1], (3, 5), 2 * PIXEL)
    uneven = Views.of_pixels(VIEWS.rotations[:2], VIEWS.shifts[:2], (3, 5), PIXEL * torch.tensor([2.0, 1.0]).numpy())
    assert torch.allclose(seen.photographs(uneven)[0], seen.photographs(coarse)[0], atol=1e-5)
    assert replace(model, object=random_cloud(5, VIEWS, MATTER, 0.1, 0)).by_waves


def test_an_even_field_is_an_even_slab():
    """Of a density of 0.05 a voxel: 11 voxels deep from the front, as the exponential law has it."""
    even = field()
    raw = torch.tensor([math.log(math.expm1(0.05)), 0.4])
    even = even.with_parameters({"output.weight": torch.zeros(2, 6), "output.bias": raw})
    grey = 0.4 + 1.5 / (1 + math.exp(-0.4))
    wanted = grey + (1 - grey) * math.exp(-0.05 * SHAPE[1])
    found = even.photographs(VIEWS)[0]
    assert torch.allclose(found, torch.tensor(wanted), atol=1e-5)
    lines = even.project(VIEWS)[1][0]
    assert torch.allclose(lines, torch.tensor(0.05 * SHAPE[1] * PIXEL * MATTER.delta), rtol=1e-5, atol=0)


def test_a_black_field_casts_the_shadow_of_its_density():
    """By Beer and Lambert, of line integrals that neural fields have anyway; from any side."""
    black = field()
    weights = {name: p.clone() for name, p in black.parameters().items()}
    weights["output.weight"] *= torch.tensor([[30.0], [0.0]])
    weights["output.bias"][1] = -40.0
    black = black.with_parameters(weights)
    black.greys = 0.0, 1.0
    depth = black.project(VIEWS)[1] / (MATTER.delta * PIXEL)
    assert float(depth.max() - depth.min()) > 0.5
    assert torch.allclose(black.photographs(VIEWS), torch.exp(-depth), atol=1e-5)


def test_gradients_of_a_field_are_those_of_finite_differences():
    start = field().to(dtype=torch.float64)
    names = list(start.parameters())
    poses = Poses.of(VIEWS[[1]])

    def frames(*weights: torch.Tensor) -> torch.Tensor:
        return start.with_parameters(dict(zip(names, weights))).photographs(poses)[0, 3, ::4]

    weights = tuple(p.double().requires_grad_() for p in start.parameters().values())
    assert torch.autograd.gradcheck(frames, weights, fast_mode=True)


def test_children_of_a_splat_look_like_it():
    parent = cloud()
    kept = parent.values_times(0.1, torch.tensor([3, 5]))
    assert torch.equal(kept["raw_amplitudes"], parent.raw_amplitudes[[3, 5]])
    assert torch.equal(kept["raw_greys"], parent.raw_greys[[3, 5]])
