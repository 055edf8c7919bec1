"""Options of the start: what was a constant of a module once reaches the work, and out of range it is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from holosplat.baselines.two_materials import Levels, TwoMaterials, told_apart
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.methods import Gaussians
from holosplat.representations import approximate, cloud_from_volume
from holosplat.tables import overridden

GRID = Grid.centred((6, 7, 5), 1e-6)
FADING = torch.linspace(0.0, 1.0, 6)[:, None, None].expand(6, 7, 5).contiguous()
"""Occupancies from nothing to one along z."""


def quiet(stage: str, fraction: float) -> None:
    pass


def test_what_counts_as_filled_decides_the_number_of_gaussians():
    counts = [len(cloud_from_volume(FADING, GRID, (1e-6, 1e-9), 1e-6, 1e-6, 10_000, f)) for f in (0.0, 0.3, 0.9)]
    assert counts == [5 * 35, 4 * 35, 35]


def test_the_rates_of_the_approximation_are_those_that_are_asked_for():
    cloud = cloud_from_volume(FADING, GRID, (1e-6, 1e-9), 1e-6, 1e-6).on("reference")
    still = approximate(cloud, FADING, GRID, 3, quiet, (0.0, 0.0, 0.0, 0.0))
    amplitudes_only = approximate(cloud, FADING, GRID, 3, quiet, (0.0, 0.0, 0.0, 0.05))
    assert torch.equal(still.raw_amplitudes, cloud.raw_amplitudes)
    assert torch.equal(amplitudes_only.centres, cloud.centres)
    assert not torch.equal(amplitudes_only.raw_amplitudes, cloud.raw_amplitudes)


def test_slivers_are_left_out_below_the_asked_occupancy():
    slab = torch.zeros(3, 5, 4)
    slab[1, 2] = 0.1  # too thin for a lighter material
    levels = (1.0, 0.01)
    assert told_apart(slab, levels, 1)[0].sum() > 0
    assert told_apart(slab, levels, 1, TwoMaterials(sliver=0.2))[0].sum() == 0


def test_how_much_makes_two_materials_is_an_option():
    found = Levels(high=2.0, low=1.0, spread=0.25, share=0.5, deviation=0.15)
    assert found.are_two()
    assert not found.are_two(TwoMaterials(least_share=0.6))
    assert not found.are_two(TwoMaterials(largest_spread=0.2))
    assert not found.are_two(TwoMaterials(largest_deviation=0.1))


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("estimate.width=0", "width must be at least 1"),
        ("two_materials.rounds=0", "two_materials: rounds must be at least 1, but it is 0"),
        ("two_materials.blur=-1", "blur must not be negative"),
        ("volume.settling=-1", "settling must not be negative"),
        ("filled=-0.1", "filled must not be negative"),
        ("approximate_rates.centres=-1", "centres must not be negative"),
    ],
)
def test_options_out_of_range_are_refused(assignment, message):
    with pytest.raises(InputError, match=message):
        overridden(Gaussians(), [assignment])


def test_rounds_are_an_option_of_the_method():
    found = overridden(Gaussians(), ["two_materials.rounds=3"])
    assert found == replace(Gaussians(), two_materials=TwoMaterials(rounds=3))
