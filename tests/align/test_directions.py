"""Directions that frames hardly tell."""

from __future__ import annotations

import torch

from holosplat.align.derivatives import NUMBERS, hardly_told


def test_the_widest_direction_is_named_in_units_of_the_prior():
    """In one view a turn and a shift trade off; in another the roll is not told at all; a third tells everything."""
    expected = torch.full((len(NUMBERS),), 2.0, dtype=torch.float64)
    expected[5] = 0.0
    information = torch.diag_embed(torch.full((3, len(NUMBERS)), 1e6, dtype=torch.float64))
    information[0, 0, 0] = information[0, 3, 3] = 5e5
    information[0, 0, 3] = information[0, 3, 0] = -(5e5 - 1e-3)
    information[1, 4, 4] = 0.0
    prior = torch.diag(torch.where(expected > 0, expected.clamp_min(1e-9) ** -2, torch.tensor(1e12)))
    covariances = torch.linalg.inv(information + prior)
    assert hardly_told(covariances, expected) == [
        "hardly told: shift x with turn y, in views 0 (100% of what was uncertain is left)",
        "hardly told: roll, in views 1 (100% of what was uncertain is left)",
    ]
    assert hardly_told(covariances[2:], expected) == []
