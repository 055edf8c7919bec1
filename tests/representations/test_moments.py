"""Gaussians with the moments of the matter in each cell."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.matter import Matter
from holosplat.representations import GaussianCloud
from holosplat.representations.initialise import SMOOTH, cloud_of_moments, moments

MATTER = Matter.one(1e-6, 1e-9)


def ball_in_halves(shape: tuple[int, int, int], middle: tuple[float, float, float], radius: float) -> torch.Tensor:
    """Occupancy of half cells [2Z, 2Y, 2X] by points, 6 along an edge; middle `(x, y, z)` and radius in cells."""
    z, y, x = (np.arange(12 * n) / 12 + 1 / 24 - 0.5 for n in shape)
    square = (x - middle[0]) ** 2 + (y[:, None] - middle[1]) ** 2 + (z[:, None, None] - middle[2]) ** 2
    inside = (square < radius**2).reshape(2 * shape[0], 6, 2 * shape[1], 6, 2 * shape[2], 6)
    return torch.from_numpy(inside.mean(axis=(1, 3, 5)))


def covariances_of(cloud: GaussianCloud) -> np.ndarray:
    """R diag(s²) Rᵀ [N, 3, 3] in the cloud's unit."""
    w, x, y, z = cloud.quaternions.double().numpy().T
    turned = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", turned, cloud.scales.double().numpy() ** 2, turned)


def test_half_a_cell_by_hand():
    halves = torch.zeros(2, 4, 6)
    halves[:, 2:, 3] = 1.0  # the second cell in y, of the second in x its right half
    mass, centre, covariance = moments(halves, 0.02)
    assert mass.tolist() == [0.5]
    assert centre.tolist() == [[1.25, 1.0, 0.0]]
    assert torch.allclose(covariance[0], torch.diag(torch.tensor([1 / 48, 1 / 12, 1 / 12]).double()))


def test_cells_with_less_are_left_out():
    halves = torch.zeros(4, 4, 4)
    halves[0, 0, 0], halves[2, 2, 2] = 0.8, 0.4  # a tenth and a twentieth of a cell
    assert len(moments(halves, 0.02)[0]) == 2
    assert moments(halves, 0.07)[0].tolist() == pytest.approx([0.1])
    assert len(moments(halves, 0.2)[0]) == 0


def test_all_moments_of_a_ball():
    """4/3 π r³, its centre, and r²/5 along every axis, in an odd-sized box whose edges differ.

    Half cells at the edge count as filled evenly: 2.3 of 10 of them, whose matter moves outwards by an eighth.
    """
    radius, middle = 4.3, (6.2, 5.1, 7.35)
    mass, centre, covariance = moments(ball_in_halves((15, 11, 13), middle, radius), 0.0)
    whole = mass.sum()
    assert float(whole) == pytest.approx(4 / 3 * math.pi * radius**3, rel=2e-3)
    assert torch.allclose((mass[:, None] * centre).sum(0) / whole, torch.tensor(middle).double(), atol=2e-3)
    away = centre - torch.tensor(middle).double()
    second = (mass[:, None, None] * (covariance + away[:, :, None] * away[:, None])).sum(0) / whole
    assert torch.allclose(second, radius**2 / 5 * torch.eye(3).double(), atol=0.05)


def test_gaussians_have_the_covariances_and_masses():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(40, 3, 3))
    covariance = torch.from_numpy(0.05 * root @ root.transpose(0, 2, 1))
    mass, centre = torch.from_numpy(rng.uniform(0.1, 1, 40)), torch.from_numpy(rng.normal(size=(40, 3)))
    cloud = cloud_of_moments(mass, centre, covariance, 3e-6, 1.5e-6, MATTER)
    wanted = 4 * (covariance + SMOOTH * torch.eye(3).double())
    assert np.allclose(covariances_of(cloud), wanted.numpy(), rtol=1e-5, atol=1e-5)
    assert torch.allclose(cloud.masses()[:, 0].double(), 8 * mass, rtol=1e-4)
    assert torch.allclose(cloud.centres.double(), 2 * centre, rtol=1e-6)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.6, 0.0, 0.8), (0.48, 0.64, 0.6)])
def test_the_spectrum_of_a_ball_converges_with_the_second_order(direction):
    """The Fourier transform of a ball is 3 (sin x − x cos x) / x³ of its mass, with x = q r (Guinier & Fournet 1955,
    eq. 26); that of the cloud, less its smoothing, comes nearer four times when cells are halved."""

    def error(cells: int) -> float:
        radius, middle = 0.31 * cells, np.array([0.48, 0.53, 0.5]) * cells
        parts = moments(ball_in_halves((cells, cells, cells), tuple(middle), radius), 0.0)
        cloud = cloud_of_moments(*parts, 1.0, 1.0, MATTER)
        spread, masses, away = (
            covariances_of(cloud),
            cloud.masses()[:, 0].double().numpy(),
            cloud.centres.double().numpy() - middle,
        )
        left = []
        for x in (3.0, 4.0, 5.2, 6.5):
            q = x / radius * np.array(direction)
            wave = np.exp(1j * (away @ q) - 0.5 * np.einsum("i,nij,j->n", q, spread, q))
            found = (masses * wave).sum() * np.exp(0.5 * SMOOTH * q @ q) / masses.sum()
            left.append(abs(found - 3 * (math.sin(x) - x * math.cos(x)) / x**3))
        return float(np.sqrt(np.mean(np.square(left))))

    coarse, fine = error(9), error(18)
    assert coarse < 0.01
    assert fine < coarse / 3
