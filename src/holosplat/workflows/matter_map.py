"""The probability that a voxel is matter, by how often voxels of its occupancy were matter in rehearsals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..checks import require, shaped
from ..geometry import Grid
from ..metrics import robust_material_delta
from ..metrics.volumes import require_same_grid
from ..volume import Volume

BINS = np.linspace(-0.5, 1.5, 41)
"""Ends of the bins in which occupancies are counted; those beyond count in the outermost bins."""
VOXELS, MATTER = "voxels", "matter"


def _bins_of(occupancies: np.ndarray) -> np.ndarray:
    return np.clip(np.digitize(occupancies, BINS) - 1, 0, len(BINS) - 2)


def occupancy_counts(found: Volume, truth: Volume) -> dict[str, list[float]]:
    """How many voxels of a reconstruction have an occupancy in each of the `BINS` [N], and of how many the truth, on
    the same grid, is matter [N]. Occupancy and matter are those of `metrics.volumes`, with the δ of the true material.

    Errors: `InputError` for other grids, and for a truth without matter.
    """
    require_same_grid(found.grid, truth.grid)
    unit = robust_material_delta(truth)
    which, matter = _bins_of(found.delta / unit), truth.delta / unit > 0.5
    counts = (np.bincount(each.ravel(), minlength=len(BINS) - 1) for each in (which, which[matter]))
    return {name: each.astype(float).tolist() for name, each in zip((VOXELS, MATTER), counts)}


def matter_probabilities(voxels: np.ndarray, matter: np.ndarray) -> np.ndarray:
    """Probabilities [N] that voxels of occupancies in N ascending bins are matter, where `matter` [N] of `voxels` [N]
    were.

    They are the shares (m + ½)/(n + 1), of Jeffreys' prior, and made to rise with occupancy by joining adjacent bins,
    which is their weighted least-squares fit (Ayer et al. 1955; as calibration: Zadrozny & Elkan 2002, KDD). Errors:
    `InputError` for counts that differ in length, and for more matter than voxels.
    """
    from scipy.optimize import isotonic_regression  # which takes long to load

    shaped("counts of matter", matter, np.shape(voxels))
    require(bool((matter <= voxels).all()), "voxels of matter must be among those counted, but there are more of them.")
    weights = voxels + 1.0
    return isotonic_regression((matter + 0.5) / weights, weights=weights).x


@dataclass(frozen=True)
class MatterMap:
    """The probability that a voxel is matter, given its occupancy.

    found: the reconstruction whose voxels are judged; unit: the δ of its material; table: [N] probabilities by `BINS`
    """

    found: Volume
    unit: float
    table: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """Probabilities [Z, Y, X] float32."""
        return self.table[_bins_of(self.found.delta / self.unit)].astype(np.float32)

    def on(self, grid: Grid) -> np.ndarray:
        """Probabilities on another grid, [Z, Y, X] float32, linear between voxels; beyond the map those of its edge."""
        from scipy.ndimage import map_coordinates  # which takes long to load

        own = self.found.grid
        places = [
            (axis - start) / edge
            for axis, start, edge in zip(grid.axes()[::-1], own.origin[::-1], own.voxel_size[::-1])
        ]
        return map_coordinates(self.values, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest")

    @property
    def expected_dice(self) -> float:
        """Dice expected of the voxels beyond half of the material's δ: 2 Σ_M p / (|M| + Σ p), the ratio of expected
        overlap and sizes; nan without matter and chance of it."""
        values, matter = self.values.astype(np.float64), self.found.delta / self.unit > 0.5
        sizes = float(matter.sum() + values.sum())
        return 2 * float(values[matter].sum()) / sizes if sizes else math.nan
