"""Light found on coarse pixels is the same on fine ones, and boxes of air are where they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.methods.trials import binned_options, finer_light
from holosplat.optics.background import Light, LightOptions


def lit(shape: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames [3, H, W] of air with white noise, and their smooth light."""
    y, x = np.mgrid[: shape[0], : shape[1]] / np.array(shape)[:, None, None] - 0.5
    slopes = ((1, 0.3), (-0.5, 1), (0.2, 0.2))
    light = torch.from_numpy(np.stack([1 + 0.1 * (a * x + b * y + 0.3 * np.cos(9 * x) * y) for a, b in slopes])).float()
    return light * (1 + 0.003 * torch.randn(light.shape, generator=torch.Generator().manual_seed(3))), light


@pytest.mark.parametrize(("shape", "factor"), [((93, 140), 3), ((47, 101), 2)])
def test_light_of_coarse_pixels_is_that_of_fine_ones(shape, factor):
    """On rectangular frames of odd sides, of which binning cuts rows and columns."""
    frames, light = lit(shape)
    air = LightOptions("smooth", air=((0, shape[0], 0, shape[1]),))
    whole = Light.of(frames, air)
    coarse = whole.part(torch.arange(3), factor)
    assert coarse.air.shape[1:] == (shape[0] // factor, shape[1] // factor)
    fine = finer_light(coarse, frames, factor)
    assert fine.air.all()
    torch.testing.assert_close(fine.factor(), whole.factor(), rtol=0, atol=1e-3)
    assert float((fine.factor() / light - 1).abs().max()) < 0.01 < float((light - 1).abs().max())
    assert fine.background is not None
    assert whole.background is not None
    deviations = [each.covariances.diagonal(dim1=1, dim2=2)[:, :5] for each in (fine.background, whole.background)]
    torch.testing.assert_close(*deviations, rtol=0.01, atol=0)
    assert not fine.noise.has_grain


def test_light_of_the_same_pixels_keeps_its_factor():
    frames, _ = lit((31, 45))
    known = Light.of(frames, LightOptions("smooth", air=((0, 31, 0, 45),)))
    assert torch.equal(finer_light(known, frames, 1).factor(), known.factor())


def test_boxes_of_air_are_binned_with_the_frames():
    """Rows 0, 1 and 2 are the first of 93, binned by 3; of 140 columns one is cut at the left."""
    boxes = ((0, 20, 3, 31), (90, 93, 130, 140), (1, 2, 1, 2))
    given = LightOptions(air=boxes)
    assert binned_options(given, (93, 140), 3).air == ((0, 6, 1, 10), (30, 31, 43, 46), (0, 1, 0, 1))
    assert binned_options(given, (93, 140), 1) is given
    assert binned_options(replace(given, air=()), (93, 140), 3).air == ()
