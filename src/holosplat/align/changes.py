"""Changes of views from their plan, as numbers, words and tables; the common motion that no frame determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..geometry import Views
from ..scan import Exposures


def numbers_of(found: Exposures, planned: Exposures) -> Tensor:
    """[V, 7] shifts [pixels], turns [rad], and logarithms of distance and magnification, that make `planned` exposures
    `found`."""
    turns = np.einsum("vij,vkj->vik", found.views.rotations, planned.views.rotations)
    shifts = (found.views.shifts - planned.views.shifts) / planned.views.pixel_sizes[:, None]
    near = np.where(planned.distance > 0, found.distance / np.where(planned.distance > 0, planned.distance, 1), 1)
    vectors = Rotation.from_matrix(turns).as_rotvec()
    larger = np.log(planned.views.pixel_sizes / found.views.pixel_sizes)
    return torch.from_numpy(np.concatenate([shifts, vectors, np.log(near)[:, None], larger[:, None]], axis=1))


def changes(found: Exposures, planned: Exposures) -> np.ndarray:
    """[V, 7]: shifts x, y [pixels], turns about x, y, z of the lab [degrees], shares of distance and magnification."""
    numbers = numbers_of(found, planned).numpy()
    return np.concatenate([numbers[:, :2], np.rad2deg(numbers[:, 2:5]), np.expm1(numbers[:, 5:])], axis=1)


def in_words(of_views: np.ndarray) -> str:
    """Root mean squares of `changes` [V, 7], without the magnification's."""
    root = np.sqrt(np.square(of_views).mean(0))
    across = np.hypot(root[[0, 2]], root[[1, 3]]) / np.sqrt(2)
    return (
        f"changes of the plan (rms): shifts {across[0]:.3f} pixels, turns across the beam {across[1]:.3f}°, "
        f"roll {root[4]:.3f}°, distance {root[5]:.2%}"
    )


def header(what: str, digits: int, *last: str) -> str:
    """The first line of a table of changes whose lines are those of `line`; what: `view` or `beam`."""
    shift, turn = 2 * digits + 9, 2 * digits + 11  # the width of the cells of a line
    cells = [f"shift {axis}".ljust(shift) for axis in "xy"] + [f"turn {axis}".ljust(turn) for axis in "xy"]
    return "  ".join([what, *cells, *("roll".ljust(turn), *last)]).rstrip()


def line(number: int, change: np.ndarray, error: np.ndarray, digits: int, *last: str) -> str:
    """A line of a table: shifts with so many `digits`, turns with one more, each with its standard error."""
    shifts = [f"{change[k]:+{digits + 4}.{digits}f} ± {error[k]:.{digits}f}" for k in (0, 1)]
    turns = [f"{change[k]:+{digits + 4}.{digits + 1}f}° ± {error[k]:.{digits + 1}f}" for k in (2, 3, 4)]
    return "  ".join([f"{number:4d}", *shifts, *turns, *last])


def moved_onto(found: Views, planned: Views) -> Views:
    """`found` with the object turned and moved so that its views are as near to `planned` as can be.

    The common turn is the mean of all relative ones, the common motion the least-squares one: mean turn and mean shift
    of the views are then zero. Frames stay what they are.
    """
    turns = np.einsum("vji,vjk->vik", found.rotations, planned.rotations)
    rotations = found.rotations @ Rotation.from_matrix(turns).mean().as_matrix()
    design = rotations[:, :2].reshape(-1, 3)
    away = (found.shifts - planned.shifts).reshape(-1)
    motion = np.linalg.lstsq(design, away, rcond=1e-9)[0]
    return replace(found, rotations=rotations, shifts=found.shifts - (design @ motion).reshape(-1, 2))
