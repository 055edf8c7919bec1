"""Clouds that start on a volume: how many Gaussians, and where larger ones."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from holosplat.geometry import Grid
from holosplat.representations import cloud_from_volume


def test_the_insides_of_bulky_bodies_get_larger_gaussians():
    """Beyond `max_count`, blocks deep inside a box come eight in one; mass, levels and the surface stay."""
    grid = Grid((18, 21, 26), (1e-6, 1e-6, 1e-6), (0.0, 0.0, 0.0))
    body = torch.zeros(grid.shape)
    body[2:16, 3:18, 4:22] = 1.0
    plain = cloud_from_volume(body, grid, (1e-6, 1e-9), 1e-6, 1e-6)
    few = cloud_from_volume(body, grid, (1e-6, 1e-9), 1e-6, 1e-6, max_count=2500)
    assert len(plain) == 14 * 15 * 18
    assert len(few) < 2500
    scales = few.scales[:, 0]
    assert set(scales.tolist()) == {0.5, 1.0}
    large = few.centres[scales > 0.75]
    assert len(few) == len(plain) - 7 * len(large)
    assert float(large[:, 0].min()) >= 5.5  # x: a block of the surface and half a large one from the face at 3.5
    found = few.density(grid)[0]
    assert float(found.sum()) == pytest.approx(float(body.sum()), rel=0.01)
    assert float((found[5:13, 6:15, 7:19] - 1).abs().max()) < 0.15
    assert len(cloud_from_volume(body, grid, (1e-6, 1e-9), 1e-6, 1e-6, max_count=800)) <= 800


def test_a_start_on_a_volume_loads_no_sympy():
    """Which torch imports for some ways of backward, and which takes longer than small fits."""
    code = """
import sys, torch
from holosplat.geometry import Grid
from holosplat.representations import approximate, cloud_from_volume
grid = Grid((7, 8, 9), (1e-6, 1e-6, 1e-6), (0.0, 0.0, 0.0))
body = torch.zeros(grid.shape)
body[2:5, 3:6, 4:7] = 1.0
approximate(cloud_from_volume(body, grid, (1e-6, 1e-9), 1e-6, 1e-6), body, grid, 2, lambda *said: None)
print("sympy" in sys.modules)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said == "False\n"
