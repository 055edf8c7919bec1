"""Poses as parameters of a fit: which are free, their prior, and the gauge that the object shares with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..checks import shaped
from ..geometry import Views
from ..model import Alignment, Model
from ..optics.noise import noise_levels
from ..optics.sampling import fringes
from ..scan import Exposures, Scan
from .loop import Plan, Stateless
from .optimiser import Adam, Apart, Leaves, Optimiser, Trainable
from .problem import FIXED, Batch, LossPart
from .residuals import set_aside

RATE_PX = 0.05
"""First steps of shifts, and of turns at the edge of the field [pixels]: what voxels leave is found in some twenty."""
RATE_SHARE = 0.25
"""First steps of distances, as a share of their uncertainty."""
LEAST_LEFT = 0.001
"""Mean loss of a fit without noise, in units of the frames' range: sharp cells end with so much."""
ROUNDED = 1 / 3
"""Loss over the negative logarithm of the likelihood, in standard deviations of the noise: `√(r² + c²) - c` with c of
three of them is `r² / 2c`."""
SAMPLED = 0.015
"""Share by which sampling shifts the mean distance at most where the first fringe is a pixel wide; it falls with the
square of the width. At 2.5 pixels, where this gives 0.24 %, 0.13 % was measured (docs/data/alignment.csv)."""

PLACES = {"shifts": [0, 1], "turns": [2, 3, 4], "stretches": [5], "magnified": [6]}
"""Places of the corrections of `Alignment` among the numbers of a view."""


@dataclass(frozen=True)
class PoseRefinement:
    """What is not known of V views, as standard deviations; 0: it stays as it is.

    shift [pixels], angle (turns about the axes across the beam) [rad], roll [rad], distance [share]
    so_far: [V, 7] how far the views are from the plan already: shifts x, y [pixels], turns about x, y, z of the lab
        [rad], shares of the distance and of the magnification
    magnification [share]
    edges: whether the matter is fitted with sharp edges of one known density; soft matter takes any mean distance
    """

    shift: float
    angle: float
    roll: float
    distance: float
    so_far: np.ndarray
    magnification: float = 0.0
    edges: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "so_far", shaped("so_far", np.asarray(self.so_far), (len(self.so_far), 7)))

    def __len__(self) -> int:
        return len(self.so_far)

    def __bool__(self) -> bool:
        return bool(self.deviations().any())

    def __getitem__(self, index: np.ndarray) -> PoseRefinement:
        return replace(self, so_far=self.so_far[index])

    def deviations(self) -> np.ndarray:
        """[7] of each of the numbers of a view."""
        across = [self.shift, self.shift, self.angle, self.angle]
        return np.array([*across, self.roll, self.distance, self.magnification])

    def alignment(self, device: torch.device | str = "cpu") -> Alignment:
        """No correction yet, with room for what is free."""
        turns = self.angle > 0 or self.roll > 0
        names = {"turns": turns, "shifts": self.shift > 0, "stretches": self.distance > 0}
        names["magnified"] = self.magnification > 0
        return Alignment.planned(len(self), *(name for name, free in names.items() if free), device=device)

    def after(self, alignment: Alignment) -> PoseRefinement:
        """The same of views that a fit has moved on; those that it had set aside are where they were."""
        so_far = self.so_far.copy()
        fitted = np.flatnonzero(_fitted(len(self), len(alignment)))
        for name, at in PLACES.items():
            numbers = alignment.parameters().get(name)
            if numbers is not None:
                so_far[fitted[:, None], at] += numbers.detach().cpu().numpy().reshape(len(fitted), -1)
        return replace(self, so_far=so_far)

    def tells_mean(self, exposures: Exposures) -> bool:
        """Whether the mean distance is known better from the frames than from the plan (see `SAMPLED`)."""
        return self.edges and mean_distance_error(exposures) < self.distance / np.sqrt(len(self))


def mean_distance_error(exposures: Exposures) -> float:
    """By how much a fit finds all distances too short or too long together, as a share: its waves are sampled."""
    optics = exposures.optical
    width = float(np.mean(fringes(optics))) / optics.views.pixel_size
    return SAMPLED / max(width, 1e-3) ** 2


def _fitted(count: int, used: int) -> np.ndarray:
    """Which of `count` views a fit of `used` of them looks at, [V] bool: the others are set aside for validation."""
    return ~set_aside(count, count - used)


def with_alignment(exposures: Exposures, alignment: Alignment) -> Exposures:
    """`exposures` [V] where a fit has found them; those that it had set aside are where they were."""
    fitted = np.flatnonzero(_fitted(len(exposures), len(alignment)))
    found = alignment.exposures(exposures[fitted])
    views, distance = exposures.views, exposures.distance.copy()
    rotations, shifts, scales = views.rotations.copy(), views.shifts.copy(), views.pixel_sizes / views.pitch
    rotations[fitted], shifts[fitted] = found.views.rotations, found.views.shifts
    scales[fitted], distance[fitted] = found.views.pixel_sizes / views.pitch, found.distance
    return replace(
        exposures, views=replace(views, rotations=rotations, shifts=shifts, scales=scales), distance=distance
    )


def with_pose_refinement(plan: Plan, freedom: PoseRefinement | None, train: Scan, nat: float | None = None) -> Plan:
    """`plan` with the geometry of its frames `train` as free as `freedom` says; as it is where nothing is free.

    freedom: of these frames and those that are set aside for validation, which stay where they are; nat: a unit of
    minus the logarithm of a probability in that of the loss (None: of a loss that is a mean over pixels of about |r|).
    Steps are Adam's, with the rates' decay; the prior is that of `PoseRefinement`, and what no frame can tell is kept
    (`Gauge`).
    """
    if not freedom:
        return plan
    if len(freedom) > len(train):
        freedom = freedom[_fitted(len(freedom), len(train))]
    model, exposures = plan.problem.model, train.exposures
    on = model.instrument.device
    alignment = freedom.alignment(on)
    h, w = exposures.views.shape
    noise = float(noise_levels(train.measured).mean()) / float(np.ptp(train.frames))
    weight = max(ROUNDED * noise, LEAST_LEFT) / train.frames.size if nat is None else nat
    own = {
        "alignment.shifts": RATE_PX,
        "alignment.turns": RATE_PX / (0.5 * max(h, w)),
        "alignment.stretches": RATE_SHARE * freedom.distance,
        "alignment.magnified": RATE_PX / (0.5 * max(h, w)),
    }
    expected = GeometryPrior(freedom, weight, on)

    def rates(factor: float, step: int) -> Mapping[str, float]:
        return {**plan.rates(factor, step), **{name: rate * factor for name, rate in own.items()}}

    problem = replace(plan.problem, model=replace(model, alignment=alignment), terms=(*plan.problem.terms, expected))

    def optimiser(leaves: Leaves) -> Optimiser:
        return Apart(leaves, "alignment.", lambda own: Adam(own, model.instrument.backend), plan.optimiser)

    return replace(
        plan, problem=problem, rates=rates, optimiser=optimiser, events=(*plan.events, Gauge(freedom, exposures, on))
    )


class GeometryPrior:
    """The term of what is expected of the geometry: half the sum of squares of its numbers in their deviations."""

    names = ("geometry",)
    resolved = FIXED

    def __init__(self, freedom: PoseRefinement, weight: float, device: torch.device) -> None:
        """weight: of one number; that of a fit whose data term is a mean over pixels."""
        self._weight = weight
        deviations = freedom.deviations()
        self._parts = {
            f"alignment.{name}": tuple(
                torch.from_numpy(part).to(device)
                for part in (freedom.so_far[:, at], np.where(deviations[at] > 0, deviations[at], np.inf))
            )
            for name, at in PLACES.items()
        }

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        parameters, total = model.parameters(), list[Tensor]()
        for name, (so_far, deviations) in self._parts.items():
            if name in parameters:
                away = parameters[name].reshape(so_far.shape) + so_far
                total.append((away / deviations).square().sum())
        return [LossPart("geometry", self._weight, (0.5 * torch.stack(total).sum()).float())]


class Gauge(Stateless):
    """Projects out what frames do not determine: a motion and a turn of the whole object, its size (the mean
    magnification), and a mean distance that sampling would move.

    An event of a fit: gradients and numbers are projected onto what changes frames. What is not free has no gradient.
    """

    def __init__(self, freedom: PoseRefinement, exposures: Exposures, device: torch.device | str = "cpu") -> None:
        free = freedom.deviations() > 0
        views, count = exposures.views, len(exposures)
        ones = np.full((count, 1), 0 if freedom.tells_mean(exposures) else 1.0)
        projections = {
            "alignment.shifts": projection(views.rotations[:, :2].reshape(-1, 3), np.tile(free[:2], count)),
            "alignment.turns": projection(_turns(views), np.tile(free[2:5], count)),
            "alignment.stretches": projection(ones, np.tile(free[5:6], count)),
            "alignment.magnified": projection(np.ones((count, 1)), np.tile(free[6:], count)),
        }
        self._projections = {name: kept.to(device) for name, kept in projections.items()}

    def _each(self, leaves: Leaves, of: Callable[[Tensor], Tensor | None]) -> None:
        for name, kept in self._projections.items():
            values = of(leaves[name]) if name in leaves else None
            if values is not None:
                values.copy_((kept.to(values) @ values.flatten()).reshape(values.shape))

    def on_gradients(self, leaves: Leaves) -> None:
        """Project out gradients along directions that frames do not determine."""
        self._each(leaves, lambda leaf: leaf.grad)

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """Adam's steps have their own length for each number, and leave the projection."""
        self._each(trainable.leaves, lambda leaf: leaf.detach())
        return False


def _turns(views: Views) -> np.ndarray:
    """[3V, 3] turns of the views about the lab's axes by a turn of the object: `ω = R w`."""
    return views.rotations.reshape(-1, 3)


def projection(motions: np.ndarray, free: np.ndarray) -> Tensor:
    """[N, N] float64: takes out of N numbers those that are not `free` [N], and the `motions` [N, K] that move none of
    these."""
    if not free.all():
        _, sizes, ways = np.linalg.svd(motions[~free], full_matrices=True)
        rank = int((sizes > 1e-6 * max(1.0, sizes.max(initial=0.0))).sum())
        motions = motions @ ways[rank:].T
    basis, sizes, _ = np.linalg.svd(np.where(free[:, None], motions, 0.0), full_matrices=False)
    basis = basis[:, sizes > 1e-6 * max(1.0, sizes.max(initial=0.0))]
    return torch.from_numpy(np.diag(free.astype(float)) - basis @ basis.T)
