"""What the splat and the voxeliser refuse, and what draws nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.splats import DETECTOR, DRAWS, VOLUME, cloud, error, poses, value_and_gradients
from holosplat import native
from holosplat.checks import InputError
from holosplat.projectors import splat as splat_package
from holosplat.projectors.splat import splat, voxelise


def spoiled(index: int, value: float) -> list[Tensor]:
    arrays = cloud("small", 1, 5)
    arrays[index][2] = value
    return arrays


@DRAWS
@pytest.mark.parametrize("isa", native.available_isas())
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_draws_nothing(isa, value, draw, monkeypatch):
    """The public functions refuse such clouds; the kernels must still not touch memory that is not theirs."""
    monkeypatch.setenv("HOLOSPLAT_ISA", isa)
    monkeypatch.setattr(splat_package, "_check_cloud", lambda *_: None)
    arrays = cloud("ordinary", 2, 60)
    spoilt = [(index, column) for index, width in enumerate((3, 3, 4, 2)) for column in range(width)]
    for row, (index, column) in enumerate(spoilt):
        arrays[index][row, column] = value
    good = [a[len(spoilt) :] for a in arrays]
    truth, true_gradients = value_and_gradients(lambda *a: draw(*a, "cpu"), good, torch.float32)
    image, gradients = value_and_gradients(lambda *a: draw(*a, "cpu"), arrays, torch.float32)
    assert error(image, truth.double()) < 1e-6
    assert all(error(g[len(spoilt) :], t.double()) < 1e-6 for g, t in zip(gradients, true_gradients))


BAD_CLOUDS = {
    "scales must be above zero": spoiled(1, 0.0),
    "centres must hold finite numbers": spoiled(0, math.nan),
    "amplitudes must hold finite numbers": spoiled(3, math.inf),
    "quaternions must not be zero": spoiled(2, 0.0),
    "centres must have the shape": [torch.zeros(5, 2), *cloud("small", 1, 5)[1:]],
    "scales must have the shape": [torch.zeros(5, 3), torch.ones(4, 3), *cloud("small", 1, 5)[2:]],
    "amplitudes must have 1 or 2 channels": cloud("small", 3, 5),
    "centres must be float32": [a.double() for a in cloud("small", 1, 5)],
    "centres must be a torch tensor": [np.zeros((5, 3)), *cloud("small", 1, 5)[1:]],
    "centres must hold real numbers": [torch.zeros(5, 3, dtype=torch.int64), *cloud("small", 1, 5)[1:]],
}


@pytest.mark.parametrize("message", BAD_CLOUDS)
def test_bad_clouds_are_refused(message):
    with pytest.raises(InputError, match=message):
        splat(*BAD_CLOUDS[message], *poses(1), DETECTOR)
    with pytest.raises(InputError, match=message):
        voxelise(*BAD_CLOUDS[message], VOLUME)


@pytest.mark.parametrize(
    ("message", "change"),
    [
        ("rotations must have the shape", {"rotations": torch.eye(3)}),
        ("rotations must hold proper", {"rotations": 2 * torch.eye(3)[None]}),
        ("rotations must hold proper", {"rotations": torch.diag(torch.tensor([1.0, 1.0, -1.0]))[None]}),
        ("shifts must have the shape", {"shifts": torch.zeros(2, 2)}),
        ("shifts must hold finite", {"shifts": torch.full((1, 2), math.nan)}),
        ("detector shape must be two", {"shape": (0, 4)}),
        ("detector shape must be two", {"shape": (4, 4, 4)}),
        ("cutoff must be", {"cutoff": 0.0}),
        ("pixel_variance must be", {"pixel_variance": -1.0}),
        ("backend must be one of cpu, cuda, reference", {"backend": "gpu"}),
    ],
)
def test_bad_views_and_options_are_refused(message, change):
    good = {"rotations": torch.eye(3)[None], "shifts": torch.zeros(1, 2), "shape": DETECTOR}
    with pytest.raises(InputError, match=message):
        splat(*cloud("small"), **(good | change))


def test_bad_volumes_are_refused():
    with pytest.raises(InputError, match="volume shape must be three"):
        voxelise(*cloud("small"), DETECTOR)
    with pytest.raises(InputError, match="voxel_variance must be"):
        voxelise(*cloud("small"), VOLUME, voxel_variance=math.nan)


def test_a_missing_library_is_said_and_not_replaced(monkeypatch, tmp_path):
    monkeypatch.setattr(native, "_candidates", lambda: [tmp_path])
    with pytest.raises(RuntimeError, match=r"not installed .*compiler .*backend='reference'"):
        native._folder.__wrapped__()


def test_an_unknown_build_is_refused(monkeypatch):
    monkeypatch.setenv("HOLOSPLAT_ISA", "mmx")
    with pytest.raises(RuntimeError, match="HOLOSPLAT_ISA must be one of"):
        splat(*cloud("small"), *poses(1), DETECTOR)
