"""Shadows of a known body in many orientations, and where in space and time they are seen.

The frames' information on thickness at each frequency is |H|²/σ², H the contrast transfer of one material and σ the
noise: a body is where the sum over frames of the weighted correlations with its shadow gains most likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..mesh import TriangleMesh
from ..projectors.surface import surface_thickness
from .shadows import Shadows

STRETCHES = (1.0, 1.35, 1.8)
ALIKE = 0.92
TURNS = 250
RADII = 5.0
"""Radii of a ball of the body's volume in pixels to which frames are binned."""
SPACING = 1.5
SEEN = 0.35
HELD = 0.4


@dataclass(frozen=True)
class Templates:
    """nodes: [M, P, 3] about their middle, pixels; images: [M, U, S, S] in U directions, in binned pixels."""

    nodes: np.ndarray
    images: Tensor
    directions: np.ndarray
    bin: int
    reach: float
    volume: float

    @classmethod
    def of(cls, mesh: TriangleMesh, seen: Shadows) -> Templates:
        """Of a mesh in pixels, as different as they look in the directions of `seen`."""
        radius = (3 * mesh.volume / (4 * np.pi)) ** (1 / 3)
        coarse = 1
        rotations, directions = np.unique(seen.rotations.numpy().reshape(-1, 9).round(9), axis=0, return_inverse=True)
        turned = torch.from_numpy(rotations.reshape(-1, 3, 3))
        shapes = stretched(mesh.vertices - mesh.vertices.mean(0))
        reach = max(np.linalg.norm(shape, axis=1).max() for shape in shapes)
        size = 2 * int(np.ceil(reach / coarse)) + 2
        turns = Rotation.random(TURNS, rng=np.random.default_rng(0)).as_matrix()
        both = torch.einsum("vij,ojk->ovik", turned, torch.from_numpy(turns)).reshape(-1, 3, 3)
        still, faces = torch.zeros(len(both), 2, dtype=torch.float64), torch.from_numpy(mesh.faces)
        images = torch.cat(
            [
                surface_thickness(torch.from_numpy(one / coarse), faces, both, still, (size, size), 1).float()
                for one in shapes
            ]
        ).reshape(-1, len(turned), size, size)
        kept = _different(images.flatten(1))
        nodes = np.array([shapes[k // TURNS] @ turns[k % TURNS].T for k in kept])
        return cls(nodes, coarse * images[kept], directions.reshape(-1), coarse, reach, mesh.volume)


def stretched(vertices: np.ndarray) -> list[np.ndarray]:
    """Vertices [P, 3] about their middle as they are, and longer along each principal axis at the same volume."""
    _, axes = np.linalg.eigh(vertices.T @ vertices)
    factors = [[s if j == k else s**-0.5 for j in range(3)] for s in STRETCHES[1:] for k in (2, 1, 0)]
    return [vertices, *(vertices @ (axes * np.array(f)) @ axes.T for f in factors)]


def _different(rows: Tensor) -> list[int]:
    """Numbers of rows [M, Q] that no earlier kept one resembles."""
    unit = rows / rows.norm(dim=1, keepdim=True)
    alike = (unit @ unit.T).numpy()
    left, kept = np.ones(len(rows), dtype=bool), list[int]()
    for k in range(len(rows)):
        if left[k]:
            kept.append(k)
            left &= alike[k] < ALIKE
    return kept


@dataclass(frozen=True)
class Hit:
    """Where a template gains likelihood. nodes: [P, 3] at time 0; velocity: [3] pixels per unit of time."""

    gain: float
    nodes: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray


class Search:
    """Looks for templates on straight paths of given velocities [K, 3] (pixels per unit of `Shadows.times`)."""

    def __init__(self, templates: Templates, seen: Shadows, velocities: np.ndarray) -> None:
        self.templates, self.velocities = templates, velocities
        self.b = b = templates.bin
        h, w = seen.shape
        s = templates.images.shape[-1]
        self.rows, self.columns = -(-h // b), -(-w // b)
        self.pad = s
        self.size = (self.rows + 2 * s, self.columns + 2 * s)
        self.spectra = torch.fft.rfft2(templates.images, s=self.size)
        self.mask = torch.zeros(self.size)
        self.mask[s : s + self.rows, s : s + self.columns] = 1
        squared = torch.fft.rfft2(templates.images.square(), s=self.size).conj()
        part = torch.fft.irfft2(torch.fft.rfft2(self.mask) * squared, s=self.size)
        self.part = (part / templates.images.square().sum((2, 3))[..., None, None]).clamp(0, 1)
        away = np.arange(s) - (s - 1) / 2
        ball = torch.from_numpy((np.hypot(away[:, None], away) <= 0.5 * templates.reach / b).astype(np.float32))
        self.ball = torch.fft.rfft2(ball, s=self.size).conj()
        self.cover = torch.fft.irfft2(torch.fft.rfft2(self.mask) * self.ball, s=self.size) / ball.sum()
        self.cover = self.cover.flatten()
        half = np.array([w, h, w]) / 2 + np.abs(velocities).max(0)
        axes = [np.arange(-a, a + 0.1, SPACING) for a in half]
        self.grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def weights(self, seen: Shadows, n: int) -> Tensor:
        fy, fx = np.fft.fftfreq(self.size[0], self.b), np.fft.rfftfreq(self.size[1], self.b)
        chi = np.pi * seen.fringes[n] * (fy[:, None] ** 2 + fx**2)
        return torch.from_numpy((seen.contrast[n] * np.sin(chi)) ** 2).float() * self.b**2

    def places(self, seen: Shadows, n: int, velocity: np.ndarray, points: np.ndarray) -> Tensor:
        """Numbers of the binned pixels at which the templates' corners lie; -1 beyond the raster."""
        (h, w), s = seen.shape, self.templates.images.shape[-1]
        q = (points + velocity * seen.times[n]) @ seen.rotations[n, :2].numpy().T - seen.shifts[n].numpy()
        corner = np.rint((q + 0.5 * np.array([w, h])) / self.b - s / 2 + self.pad).astype(np.int64)
        ok = ((corner >= 0) & (corner <= np.array(self.size[::-1]) - s)).all(1)
        return torch.from_numpy(np.where(ok, corner[:, 1] * self.size[1] + corner[:, 0], 0))

    def tops(self, seen: Shadows, most: int = 12, apart: float = 4.0) -> list[Hit]:
        """The best places of `seen`, each `apart` pixels from the better ones."""
        t, (h, w), b, p = self.templates, seen.shape, self.b, self.pad
        gains, balls = [], []
        for n in range(len(seen)):
            image = np.pad(seen.thickness[n], ((0, self.rows * b - h), (0, self.columns * b - w)))
            full = torch.zeros(self.size)
            full[p : p + self.rows, p : p + self.columns] = torch.from_numpy(
                image.reshape(self.rows, b, self.columns, b).mean((1, 3)).astype(np.float32)
            )
            spectrum, weights = torch.fft.rfft2(full), self.weights(seen, n)
            balls.append((torch.fft.irfft2(spectrum * self.ball, s=self.size) / (t.volume / b**2)).flatten())
            own = self.spectra[:, t.directions[n]]
            twice = torch.full((weights.shape[-1],), 2.0)
            twice[0] = 1
            whole = (own.abs().square() * weights * twice).sum((-1, -2)) / (self.size[0] * self.size[1])
            energy = whole[:, None] * self.part[:, t.directions[n]].flatten(1)
            gains.append(2 * torch.fft.irfft2(spectrum * weights * own.conj(), s=self.size).flatten(1) - energy)
        found: list[Hit] = []
        rows = []
        for k, velocity in enumerate(self.velocities):
            index = [self.places(seen, n, velocity, self.grid) for n in range(len(seen))]
            cover = torch.stack([self.cover[i] for i in index])
            held = torch.stack([balls[n][i] for n, i in enumerate(index)]) - HELD * cover
            usable = cover > SEEN
            sure = (usable.sum(0) >= 0.4 * len(seen)) & (torch.where(usable, held, 1.0).amin(0) > 0)
            chosen = torch.nonzero(sure)[:, 0]
            if not len(chosen):
                continue
            total = sum(gains[n][:, i[chosen]] for n, i in enumerate(index))
            best, which = total.max(0)
            rows += list(zip(best.tolist(), which.tolist(), self.grid[chosen.numpy()], [k] * len(best)))
        rows.sort(key=lambda row: -row[0])
        for gain, which, centre, k in rows:
            if gain <= 0 or len(found) == most:
                break
            if all(np.linalg.norm(centre - hit.centre) > apart for hit in found):
                found.append(Hit(gain, t.nodes[which] + centre, centre, self.velocities[k]))
        return found
