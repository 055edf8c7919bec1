"""Scores of a reconstructed volume against the true one: errors, Dice, quantitative δ and β, and resolution.

Matter. Occupancy is δ divided by the material's δ, and a voxel is matter where it exceeds ½. The material's δ
may be negative (a void in a medium), and so may β (cells in plasma); β may also be zero everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..checks import InputError, require
from ..geometry import Grid
from ..mesh import TriangleMesh, areas
from ..volume import Volume
from .images import (
    FIXED_THRESHOLD,
    fourier_shell_correlation,
    half_bit_threshold,
    json_number,
    resolution,
    ring_counts,
)

_CURVES = ("frequency", "fsc", "half_bit")


@dataclass(frozen=True)
class VolumeScores:
    """Scores of a reconstruction against the truth, on the truth's grid.

    - relative_error_delta, relative_error_beta: ‖V - V₀‖/‖V₀‖ over all voxels; None where the truth has no β
    - dice: overlap of the voxels with more than half of `material_delta`
    - mean_delta, mean_beta, true_mean_delta, true_mean_beta: means over the true matter's voxels
    - delta_deviation, beta_deviation, ratio_deviation: (found - true)/true, positive where the magnitude is
      too large; None where the true one is 0
    - ratio, true_ratio: mean δ / mean β; None where mean β is 0
    - resolution_fixed, resolution_half_bit: full-period resolution [m] where the FSC falls below 0.143 and
      ½-bit; None: never below, the sampling is the limit; inf: below from the first shell on
    - pitch: the voxel edge [m] that frequencies refer to (the longest one)
    - frequency [cycles/voxel], fsc, half_bit: [R] the shell correlation of δ and its ½-bit threshold
    """

    relative_error_delta: float
    relative_error_beta: float | None
    dice: float
    material_delta: float
    mean_delta: float
    true_mean_delta: float
    delta_deviation: float
    mean_beta: float
    true_mean_beta: float
    beta_deviation: float | None
    ratio: float | None
    true_ratio: float | None
    ratio_deviation: float | None
    resolution_fixed: float | None
    resolution_half_bit: float | None
    pitch: float
    frequency: np.ndarray
    fsc: np.ndarray
    half_bit: np.ndarray

    def as_dict(self) -> dict[str, float | str | None]:
        """The numbers, ready for JSON, under the fields' names (no curves)."""
        return {f.name: json_number(getattr(self, f.name)) for f in fields(self) if f.name not in _CURVES}

    def curves(self) -> dict[str, list[float]]:
        """The curves, ready for JSON: `frequency` [cycles/voxel], `fsc`, `half_bit`."""
        return {name: getattr(self, name).tolist() for name in _CURVES}


def volume_scores(reconstruction: Volume, truth: Volume, material_delta: float | None = None) -> VolumeScores:
    """Scores of `reconstruction` against `truth`, which must lie on the same grid.

    material_delta: the material's δ (dimensionless); None: the truth's robust maximum,
    `robust_material_delta`. Raises `InputError` when the grids differ, or when the truth holds no matter at
    half of the material's δ.
    """
    require_same_grid(reconstruction.grid, truth.grid)
    material = robust_material_delta(truth) if material_delta is None else float(material_delta)
    require(material != 0 and np.isfinite(material), f"material δ must be a number but 0; it is {material!r}.")
    found, true = reconstruction.delta / material > 0.5, truth.delta / material > 0.5
    require(
        bool(true.any()),
        f"the truth holds no voxel with more than half of the material's δ = {material:g}; correct that δ.",
    )
    delta, true_delta = _mean_inside(reconstruction.delta, true), _mean_inside(truth.delta, true)
    beta, true_beta = _mean_inside(reconstruction.beta, true), _mean_inside(truth.beta, true)
    ratio, true_ratio = _divide(delta, beta), _divide(true_delta, true_beta)
    return VolumeScores(
        relative_error_delta=_relative_error(reconstruction.delta, truth.delta) or 0.0,
        relative_error_beta=_relative_error(reconstruction.beta, truth.beta),
        dice=dice(found, true),
        material_delta=material,
        mean_delta=delta,
        true_mean_delta=true_delta,
        delta_deviation=delta / true_delta - 1.0,
        mean_beta=beta,
        true_mean_beta=true_beta,
        beta_deviation=_deviation(beta, true_beta),
        ratio=ratio,
        true_ratio=true_ratio,
        ratio_deviation=_deviation(ratio, true_ratio),
        **_shells(reconstruction, truth),
    )


def dice(mask_a: np.ndarray, mask_b: np.ndarray) -> float:
    """Dice overlap 2|A∩B| / (|A| + |B|) of two boolean arrays of one shape (Dice 1945); 1 if both empty."""
    a, b = np.asarray(mask_a, dtype=bool), np.asarray(mask_b, dtype=bool)
    if a.shape != b.shape:
        raise InputError(f"Dice needs two masks of one shape, but got {a.shape} and {b.shape}.")
    total = int(a.sum()) + int(b.sum())
    return 2.0 * int((a & b).sum()) / total if total else 1.0


def robust_material_delta(volume: Volume) -> float:
    """The material's δ: the median of the voxels beyond half of the extreme δ (the one of largest magnitude).

    It is exact for a uniform material of any volume fraction, and no partly filled or outlying voxel shifts
    it. Raises `InputError` for a volume without matter.
    """
    extreme = float(volume.delta.flat[int(np.argmax(np.abs(volume.delta)))])
    require(extreme != 0.0, "the volume's δ is zero everywhere, so it has no material; check the file.")
    return float(np.median(volume.delta[volume.delta / extreme > 0.5].astype(np.float64)))


def require_same_grid(first: Grid, second: Grid) -> None:
    """Raise `InputError` unless both grids have the same voxels (to 1e-6 in size, 1e-3 voxels in place)."""
    size = np.asarray(second.voxel_size)
    same = (
        first.shape == second.shape
        and np.allclose(first.voxel_size, size, rtol=1e-6, atol=0)
        and bool(np.all(np.abs(np.subtract(first.origin, second.origin)) <= 1e-3 * size))
    )
    if not same:
        raise InputError(
            f"the volumes must lie on one grid, but they lie on {first} and {second}; "
            "voxelise the reconstruction on the truth's grid first."
        )


def _shells(reconstruction: Volume, truth: Volume) -> dict:
    edges = np.asarray(truth.grid.voxel_size[::-1])
    pitch = float(edges.max())
    relative = edges / pitch
    frequency, fsc = fourier_shell_correlation(reconstruction.delta, truth.delta, relative)
    half_bit = half_bit_threshold(ring_counts(truth.grid.shape, relative))
    return {
        "resolution_fixed": resolution(frequency, fsc, FIXED_THRESHOLD, pitch),
        "resolution_half_bit": resolution(frequency, fsc, half_bit, pitch),
        "pitch": pitch,
        "frequency": frequency,
        "fsc": fsc,
        "half_bit": half_bit,
    }


def _relative_error(found: np.ndarray, true: np.ndarray) -> float | None:
    """‖found - true‖ / ‖true‖ in float64; None where the truth is zero."""
    true = np.asarray(true, dtype=np.float64)
    return _divide(float(np.linalg.norm(found - true)), float(np.linalg.norm(true)))


def _mean_inside(values: np.ndarray, mask: np.ndarray) -> float:
    return float(np.mean(values[mask], dtype=np.float64))


def _divide(numerator: float, denominator: float) -> float | None:
    return numerator / denominator if denominator != 0 else None


def _deviation(found: float | None, true: float | None) -> float | None:
    return found / true - 1.0 if found is not None and true else None


def normal_distance(one: TriangleMesh, other: TriangleMesh) -> float:
    """Root-mean-square distance [m] of two closed surfaces: of each from the nearest points of the other, both ways.

    The mean over a surface is over its vertices, each with the area around it; motion along a surface costs nothing.
    """
    squares = [_mean_square(one, other), _mean_square(other, one)]
    return float(np.sqrt(np.mean(squares)))


def distances(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Distances [P] [m] of `points` [P, 3] [m] from the nearest points of the triangles of `mesh`."""
    from scipy.spatial import KDTree  # which takes long to load

    corners = mesh.vertices[mesh.faces]
    middles = corners.mean(1)
    reach = np.linalg.norm(corners - middles[:, None], axis=-1).max()
    used = KDTree(mesh.vertices[np.unique(mesh.faces)])
    # the nearest triangle is no farther than the nearest vertex, its middle no farther than its reach beyond that
    near = KDTree(middles).query_ball_point(points, used.query(points)[0] + reach)
    counts = np.array([len(found) for found in near])
    which = np.concatenate([np.asarray(found, dtype=np.int64) for found in near])
    found = _to_triangles(np.repeat(points, counts, axis=0), corners[which])
    return np.minimum.reduceat(found, np.cumsum([0, *counts[:-1]]))


def _mean_square(of: TriangleMesh, to: TriangleMesh) -> float:
    weights = areas(of)
    used = weights > 0
    return float(np.average(distances(of.vertices[used], to) ** 2, weights=weights[used]))


def _to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances [N] of points [N, 3] from triangles [N, 3, 3], each from its own: of the plane inside, or a side."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    unit = normal / np.maximum(length, np.finfo(float).tiny)[:, None]
    inside, sides = length > 0, []
    for p, q in ((a, b), (b, c), (c, a)):
        inside = inside & (np.einsum("ni,ni->n", np.cross(q - p, points - p), unit) >= 0)
        way = q - p
        square = np.maximum(np.einsum("ni,ni->n", way, way), np.finfo(float).tiny)
        part = np.clip(np.einsum("ni,ni->n", points - p, way) / square, 0, 1)
        sides.append(np.linalg.norm(points - p - part[:, None] * way, axis=1))
    plane = np.abs(np.einsum("ni,ni->n", points - a, unit))
    return np.where(inside, plane, np.minimum.reduce(sides))
