"""Template matching: shadows of a known body in many poses, in space and time.

Frames measure thickness at each frequency with the information W = |H|²/σ², H the contrast transfer and σ the noise. A
body is where its shadows P gain most likelihood beside the thickness T, Σ over frames of 2⟨T, W P⟩ - ⟨P, W P⟩: all
frames of several times together, each where a straight path leads. Edges count for more than matter does, so
that bodies that lie behind each other do not pass for one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..frames import rfft_weights
from ..mesh import TriangleMesh
from ..projectors.surface import surface_thickness
from .shadows import Shadows

STRETCHES = (1.35, 1.8)
"""Bodies are also looked for so much longer along a principal axis, at the same volume: red cells in flow are."""
TURNS, ALIKE = 200, 0.92
"""Random turns of each shape, and the correlation of shadows in all directions above which one stands for both."""
SPACING = 1.5
"""Between places that are tried [pixels]; the best ones are improved."""
VISIBLE, TIMES = 0.35, 0.4
"""Part of a ball about the centre that a frame must see to count, and part of the frames that must count."""
HELD = 0.25
"""Part of the body's volume that each counted frame must show about its centre."""
APART = 4.0
"""Least distance of the places of one search [pixels]."""


@dataclass(frozen=True)
class Templates:
    """matrices: [M, 3, 3] of the poses; images: [M, U, S, S] thickness in U directions [pixels]; directions: [N] of the
    frames; reach: radius about the centre [pixels]; volume: [pixels³]."""

    matrices: np.ndarray
    images: Tensor
    directions: np.ndarray
    reach: float
    volume: float

    @classmethod
    def of(cls, mesh: TriangleMesh, seen: Shadows) -> Templates:
        """Of a mesh about its centre [pixels]: poses that differ in what the frames of `seen` show of them."""
        from scipy.spatial.transform import Rotation  # which takes long to load

        rotations, directions = np.unique(seen.rotations.numpy().reshape(-1, 9).round(9), axis=0, return_inverse=True)
        shapes = stretched(mesh.vertices)
        reach = max(float(np.linalg.norm(mesh.vertices @ shape.T, axis=1).max()) for shape in shapes)
        size = 2 * int(np.ceil(reach)) + 2
        turns = Rotation.random(TURNS, rng=np.random.default_rng(0)).as_matrix()
        both = torch.from_numpy(np.einsum("vij,ojk->ovik", rotations.reshape(-1, 3, 3), turns).reshape(-1, 3, 3))
        still, faces = torch.zeros(len(both), 2, dtype=torch.float64), torch.from_numpy(mesh.faces)
        nodes = [torch.from_numpy(mesh.vertices @ shape.T) for shape in shapes]
        images = torch.cat([surface_thickness(one, faces, both, still, (size, size), 1).float() for one in nodes])
        images = images.reshape(-1, len(rotations), size, size)
        kept = different(images.flatten(1))
        matrices = np.array([turns[k % TURNS] @ shapes[k // TURNS] for k in kept])
        return cls(matrices, images[kept], directions.reshape(-1), reach, mesh.volume)


def stretched(vertices: np.ndarray) -> list[np.ndarray]:
    """Matrices [3, 3]: one, and those that stretch along a principal axis of vertices [P, 3] at the same volume."""
    _, axes = np.linalg.eigh(vertices.T @ vertices)
    factors = [[s if j == k else s**-0.5 for j in range(3)] for s in STRETCHES for k in (2, 1, 0)]
    return [np.eye(3), *((axes * np.array(f)) @ axes.T for f in factors)]


def different(rows: Tensor) -> list[int]:
    """Numbers of rows [M, Q] that no earlier one of them resembles."""
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
    """A likely pose of a template: its matrix [3, 3], and its centre [3] at time 0 and velocity [3] [pixels]."""

    gain: float
    matrix: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray


class TemplateSearch:
    """Looks for templates on straight paths of given velocities [K, 3] [pixels per unit of time]."""

    def __init__(self, templates: Templates, seen: Shadows, velocities: np.ndarray) -> None:
        self.templates, self.velocities = templates, velocities
        (h, w), s = seen.shape, templates.images.shape[-1]
        self.size, self.margin = (h + 2 * s, w + 2 * s), s
        self.inside = torch.zeros(self.size)
        self.inside[s : s + h, s : s + w] = 1
        self.spectra = torch.fft.rfft2(templates.images, s=self.size)
        squares = templates.images.square()
        seen_part = self._correlated(torch.fft.rfft2(self.inside), torch.fft.rfft2(squares, s=self.size))
        self.part = (seen_part / squares.sum((2, 3))[..., None]).clamp(0, 1)
        away = np.arange(s) - (s - 1) / 2
        ball = torch.from_numpy((np.hypot(away[:, None], away) <= 0.5 * templates.reach).astype(np.float32))
        counts = torch.from_numpy(rfft_weights(self.size[1]).astype(np.float32))
        powers = self.spectra.abs().square() * counts / (self.size[0] * self.size[1])
        self.information = [seen.information(n, self.size) for n in range(len(seen))]
        pairs = zip(self.information, templates.directions)
        self.whole = torch.stack([(powers[:, u] * known).sum((-1, -2)) for known, u in pairs])
        self.ball = torch.fft.rfft2(ball, s=self.size)
        self.cover = self._correlated(torch.fft.rfft2(self.inside), self.ball) / ball.sum()
        half = np.array([w, h, w]) / 2 + np.abs(velocities).max(0)
        axes = [np.arange(-a, a + 0.1, SPACING) for a in half]
        self.grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def tops(self, seen: Shadows, most: int, without: Sequence[np.ndarray] = ()) -> list[Hit]:
        """The `most` best places, the best first, none near the places `without` [3].

        Gains may be negative: between the places and poses that are tried there may be one that explains what is left.
        """
        gains, held = zip(*(self._frame(seen, n) for n in range(len(seen))))
        rows = list[tuple[float, int, int, int]]()
        for k, velocity in enumerate(self.velocities):
            corners = [self._corners(seen, n, velocity, self.grid) for n in range(len(seen))]
            chosen = torch.nonzero(self._plausible(held, corners))[:, 0]
            if len(chosen):
                total = torch.stack([gain[:, i[chosen]] for gain, i in zip(gains, corners)]).sum(0)
                best, which = total.max(0)
                rows += list(zip(best.tolist(), which.tolist(), chosen.tolist(), [k] * len(chosen)))
        found = list[Hit]()
        for gain, which, place, k in sorted(rows, reverse=True):
            centre = self.grid[place]
            if len(found) == most:
                break
            if all(np.linalg.norm(centre - other) > APART for other in (*without, *(hit.centre for hit in found))):
                found.append(Hit(gain, self.templates.matrices[which], centre, self.velocities[k]))
        return found

    def _frame(self, seen: Shadows, n: int) -> tuple[Tensor, Tensor]:
        """Gains [M, Q] of all templates whose corner is at a pixel, and the part [Q] of a volume that a ball there
        holds."""
        spectrum, direction = self._spectrum(seen, n), self.templates.directions[n]
        energy = self.whole[n][:, None] * self.part[:, direction]
        gain = 2 * self._correlated(spectrum * self.information[n], self.spectra[:, direction]) - energy
        return gain, self._correlated(spectrum, self.ball) / self.templates.volume

    def here(self, seen: Shadows, centre: np.ndarray, velocity: np.ndarray) -> Hit:
        """The best template about `centre` [3] on a path of that velocity."""
        gain, s = torch.zeros(len(self.templates.matrices)), self.margin
        for n in range(len(seen)):
            corner = int(self._corners(seen, n, velocity, centre[None])[0])
            row, column = divmod(corner, self.size[1])
            direction = self.templates.directions[n]
            known = torch.fft.irfft2(self._spectrum(seen, n) * self.information[n], s=self.size)
            patch = known[row : row + s, column : column + s]
            own = (self.templates.images[:, direction] * patch).sum((1, 2))
            gain += 2 * own - self.whole[n] * self.part[:, direction, corner]
        best = int(gain.argmax())
        return Hit(float(gain[best]), self.templates.matrices[best], centre, velocity)

    def _spectrum(self, seen: Shadows, n: int) -> Tensor:
        full, s = torch.zeros(self.size), self.margin
        full[s : s + seen.shape[0], s : s + seen.shape[1]] = torch.from_numpy(seen.thickness[n].astype(np.float32))
        return torch.fft.rfft2(full)

    def _plausible(self, held: tuple[Tensor, ...], corners: list[Tensor]) -> Tensor:
        """[G] which places hold enough matter in every frame that sees them."""
        cover = torch.stack([self.cover[i] for i in corners])
        enough = torch.stack([ball[i] for ball, i in zip(held, corners)]) > HELD * cover
        counts = cover > VISIBLE
        return (counts.sum(0) >= TIMES * len(corners)) & (enough | ~counts).all(0)

    def _correlated(self, image: Tensor, template: Tensor) -> Tensor:
        """[…, Q] from spectra: by the pixel at which the template's corner is."""
        return torch.fft.irfft2(image * template.conj(), s=self.size).flatten(-2)

    def _corners(self, seen: Shadows, n: int, velocity: np.ndarray, places: np.ndarray) -> Tensor:
        """[G] pixels at which templates have their corner, for places [G, 3]; those beyond are seen as empty."""
        h, w = seen.shape
        at = (places + velocity * seen.times[n]) @ seen.rotations[n, :2].numpy().T - seen.shifts[n].numpy()
        corner = np.rint(at + 0.5 * np.array([w, h]) + 0.5 * self.margin).astype(np.int64)
        ok = ((corner >= 0) & (corner <= np.array(self.size[::-1]) - self.margin)).all(1)
        return torch.from_numpy(np.where(ok, corner[:, 1] * self.size[1] + corner[:, 0], 0))
