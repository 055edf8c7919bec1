"""Pixel-aligned fields: gradients, any number, order and directions of views, and where points lie in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.scan import Exposures
from holosplat_bench.opponents.fields import AlignedNetwork, PixelAligned, PixelAlignedField
from holosplat_bench.opponents.fields.aligned_network import InParts
from holosplat_bench.opponents.fields.pixel_aligned import places_of

PIXEL = 1e-6
ONE = Matter.one(1e-6, 1e-9)
SMALL = AlignedNetwork((3, 4), 5, 2)
TILTED = Views.from_rotations(Rotation.random(3, np.random.default_rng(4)).as_matrix(), (9, 13), PIXEL)


def directions(count: int) -> Views:
    """Views about the axis, off centre."""
    views = Views.evenly_spaced(count, (9, 13), PIXEL)
    return replace(views, shifts=PIXEL * np.random.default_rng(1).uniform(-1, 1, (count, 2)))


def field(views: Views, seed: int = 0, matter: Matter = ONE, upper: float = 0.9) -> PixelAlignedField:
    """A field of random weights on random images, everywhere but in a corner."""
    generator = torch.Generator().manual_seed(seed)
    grid = Grid.of_views(views)
    mask = torch.ones(grid.shape, dtype=torch.bool)
    mask[:3, :2] = False
    weights = {name: w + 0.1 for name, w in PixelAligned(SMALL, seed).named_parameters()}
    images = torch.randn(len(views), 3, *views.shape, generator=generator)
    return PixelAlignedField(weights, images, views, mask, grid, matter, network=SMALL, upper=upper)


def test_points_lie_where_their_shadows_fall():
    """By the conventions' x_lab = R x_obj, with the shift in the frame's middle; rows and columns from edge to edge."""
    views = directions(3)
    grid = Grid((2, 3, 4), (PIXEL, PIXEL, PIXEL), (-2e-6, 1e-6, 3e-6))
    x, y, z = grid.axes()
    place = places_of(grid, views, torch.tensor([23, 6]))  # the last voxel, and [0, 1, 2]

    for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
        for n, point in enumerate(([x[3], y[2], z[1]], [x[2], y[1], z[0]])):
            lab = rotation @ point
            assert place[v, n, :2] * torch.tensor([13, 9]) * PIXEL / 2 == pytest.approx(lab[:2] - shift, abs=1e-12)
            middle = rotation @ grid.centre
            assert float(place[v, n, 2]) * 2 * PIXEL == pytest.approx(lab[2] - middle[2], abs=1e-12)


@pytest.mark.parametrize("views", [directions(2), directions(5), TILTED], ids=["two", "five", "tilted"])
def test_the_order_of_the_views_does_not_matter_and_their_number_may_be_any(views):
    first = field(views)
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(3))
    other = PixelAlignedField(
        first.weights, first.images[order], views[order.numpy()], first.mask, first.grid, ONE, network=SMALL, upper=0.9
    )

    values = first.values()

    torch.testing.assert_close(other.values(), values, rtol=1e-5, atol=1e-6)
    assert values.shape == (1, *first.grid.shape)
    assert float(values[0, :3, :2].abs().max()) == 0
    assert 0 < float(values.max()) <= 0.9
    assert float(values.std()) > 1e-3


@pytest.mark.parametrize("octaves", [0, 2])
def test_what_is_told_without_gradients_is_the_same_but_for_rounding(octaves, monkeypatch):
    """In float64 to the last digits, on points in and beyond the image, in more than one piece."""
    monkeypatch.setattr("holosplat_bench.opponents.fields.aligned_network.CHUNK", 64)
    generator = torch.Generator().manual_seed(5)
    network = PixelAligned(AlignedNetwork((3, 4), 5, octaves), 1).double()
    features = torch.randn(3, 5, 9, 13, generator=generator, dtype=torch.float64)
    places = 1.5 * (2 * torch.rand(3, 200, 3, generator=generator, dtype=torch.float64) - 1)
    places[:, :4, :2] = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 1.0], [1 / 13, -1 / 9]])

    torch.testing.assert_close(network.told(features, places), network(features, places), rtol=1e-12, atol=1e-13)


def test_gradients_in_parts_are_those_of_all_points_at_once(monkeypatch):
    """Of features and weights, in float64, in four pieces of which the last is smaller."""
    monkeypatch.setattr("holosplat_bench.opponents.fields.aligned_network.CHUNK", 64)
    generator = torch.Generator().manual_seed(7)
    network = PixelAligned(AlignedNetwork((3, 4), 5, 2), 1).double()
    features = torch.randn(3, 5, 9, 13, generator=generator, dtype=torch.float64, requires_grad=True)
    places = 1.2 * (2 * torch.rand(3, 215, 3, generator=generator, dtype=torch.float64) - 1)
    asked = torch.randn(215, 2, generator=generator, dtype=torch.float64)
    leaves = [features, *network.parameters()]

    found = InParts.apply(network, places, *leaves)

    gradients = torch.autograd.grad((found * asked).sum(), leaves, allow_unused=True)  # type: ignore[operator]
    wanted = torch.autograd.grad((network(features, places) * asked).sum(), leaves, allow_unused=True)
    for ours, theirs in zip(gradients, wanted):  # those of the encoder, which has no part in it, are zero or None
        torch.testing.assert_close(ours, torch.zeros_like(ours) if theirs is None else theirs, rtol=1e-10, atol=1e-12)
    assert sum(theirs is not None for theirs in wanted) == 8


def test_every_view_counts():
    views = directions(3)
    first = field(views)
    for v in range(3):
        images = first.images.clone()
        images[v] += 1
        other = PixelAlignedField(
            first.weights, images, views, first.mask, first.grid, ONE, network=SMALL, upper=first.upper
        )
        assert float((other.values() - first.values()).abs().max()) > 1e-3


@pytest.mark.parametrize("matter", [ONE, ONE.freed()], ids=["one", "free"])
def test_the_gradient_of_values_has_the_finite_differences(matter):
    """In float64, along a random direction of all weights at once: central differences, halved twice, of order two."""
    single = field(directions(2), 2, matter, 0.9 if matter.single else 0.0)
    twin = PixelAlignedField(
        {name: w.double() for name, w in single.weights.items()},
        single.images.double(),
        single.views,
        single.mask,
        single.grid,
        matter,
        network=SMALL,
        upper=single.upper,
    )
    torch.testing.assert_close(twin.values().float(), single.values(), rtol=1e-3, atol=1e-4)
    generator = torch.Generator().manual_seed(5)
    wanted = torch.randn(len(matter), *single.grid.shape, generator=generator, dtype=torch.float64)
    along = {n: torch.randn(w.shape, generator=generator, dtype=w.dtype) for n, w in twin.weights.items()}

    def moved(step: float) -> torch.Tensor:
        return (twin.with_parameters({n: w + step * along[n] for n, w in twin.weights.items()}).values() * wanted).sum()

    at = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(moved(at), at)  # type: ignore[arg-type]
    with torch.no_grad():
        difference = (moved(1e-6) - moved(-1e-6)) / 2e-6
    assert float(slope) == pytest.approx(float(difference), rel=1e-5)


def test_the_gradient_through_the_waves_has_the_finite_differences():
    """Of frames that are odd and no squares, in float32: a mean square of contrast along the gradient."""
    views = directions(2)
    start = field(views)
    instrument = Instrument(Exposures.of(views, 15.0, 0.05), 2)
    wanted = 1 + 0.05 * torch.randn(2, 9, 13, generator=torch.Generator().manual_seed(1))

    def loss(weights: dict[str, torch.Tensor]) -> torch.Tensor:
        frames = Model(start.with_parameters(weights), instrument).frames()
        return (frames - wanted).double().square().sum()

    leaves = {name: w.clone().requires_grad_() for name, w in start.weights.items()}
    gradients = torch.autograd.grad(loss(leaves), list(leaves.values()))
    norm = torch.stack([g.square().sum() for g in gradients]).sum().sqrt()
    along = {name: g / norm for name, g in zip(leaves, gradients)}
    with torch.no_grad():
        ends = [loss({n: w + step * along[n] for n, w in start.weights.items()}) for step in (1e-2, -1e-2)]
    assert float(norm) > 1e-4
    assert float(ends[0] - ends[1]) / 2e-2 == pytest.approx(float(norm), rel=0.02)


def test_what_does_not_fit_together_is_refused():
    first = field(directions(2))

    def made(**changes: object) -> PixelAlignedField:
        given = {"weights": first.weights, "images": first.images, "views": first.views, "mask": first.mask}
        given |= {"grid": first.grid, "matter": ONE, "network": SMALL} | changes
        return PixelAlignedField(**given)  # type: ignore[arg-type]

    with pytest.raises(InputError, match=r"images must have the shape \(2, 3, 9, 13\)"):
        made(images=first.images[:1])
    with pytest.raises(InputError, match="the mask must have the grid's shape"):
        made(mask=first.mask[1:])
    with pytest.raises(InputError, match=r"weights/features\.weight of the network must have the shape"):
        made(network=AlignedNetwork((3, 4), 6, 2))
    with pytest.raises(InputError, match="one material, or has δ and β free, but there are two"):
        made(matter=Matter.several((1e-6, 1e-9), (5e-7, 1e-9)))
    with pytest.raises(InputError, match="image must have 2 to 10 levels"):
        AlignedNetwork((4,))
