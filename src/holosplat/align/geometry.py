"""The estimated geometry of a run as changes of the plan, in a form for files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..checks import as_written, require, shaped
from ..scan import Scan
from .poses import PosePrior
from .views import AlignedViews

REFINED = {
    "shifts": "shift",
    "angles": "angle",
    "roll": "roll",
    "distance": "distance",
    "magnification": "magnification",
}
"""What may be refined, by the name of its field in `PosePrior`."""
TEXTS = ("refined", "words")


@dataclass(frozen=True)
class Geometry:
    """Estimated poses of V frames: training frames by a volume of their own, held-out ones by the finished volume.

    rotations [V, 3, 3], shifts [V, 2] [m], distance [V] [m], pixel_sizes [V] [m]: as found
    changes, errors: [V, 7] of the plan, as in `AlignedViews`
    held_out: [V] bool
    before, after: [V] rms of what a volume leaves unexplained of each frame, as a share of its contrast
    refined: what was looked for; words: what stayed as planned, and why
    """

    rotations: np.ndarray
    shifts: np.ndarray
    distance: np.ndarray
    pixel_sizes: np.ndarray
    changes: np.ndarray
    errors: np.ndarray
    held_out: np.ndarray
    before: np.ndarray
    after: np.ndarray
    refined: tuple[str, ...]
    words: tuple[str, ...]

    def __post_init__(self) -> None:
        count = len(self.rotations)
        ends = {"rotations": (3, 3), "shifts": (2,), "changes": (7,), "errors": (7,)}
        for each in fields(self):
            if each.name not in TEXTS:
                array = np.asarray(getattr(self, each.name), dtype=bool if each.name == "held_out" else np.float64)
                shaped(f"geometry: {each.name}", array, (count, *ends.get(each.name, ())))
                object.__setattr__(self, each.name, array)

    @classmethod
    def of_training(cls, scan: Scan, found: AlignedViews, uncertain: PosePrior) -> Geometry:
        """That of `scan` whose training frames were `found`; held-out ones are as planned until they are placed."""
        count, train, planned = len(scan), np.flatnonzero(~scan.is_test), scan.exposures
        refined = tuple(name for name, field in REFINED.items() if getattr(uncertain, field) > 0)
        nothing = cls(
            planned.views.rotations,
            planned.views.shifts,
            planned.distance,
            planned.views.pixel_sizes,
            np.zeros((count, 7)),
            np.zeros((count, 7)),
            scan.is_test,
            np.zeros(count),
            np.zeros(count),
            refined,
            found.words,
        )
        return nothing.with_frames(train, found)

    def with_frames(self, at: np.ndarray, found: AlignedViews) -> Geometry:
        """The same with the frames `at` [K] where they were `found`."""
        views = found.exposures.views
        numbers = {
            "rotations": views.rotations,
            "shifts": views.shifts,
            "distance": found.exposures.distance,
            "pixel_sizes": views.pixel_sizes,
            **{name: getattr(found, name) for name in ("changes", "errors", "before", "after")},
        }
        changed = {}
        for name, values in numbers.items():
            changed[name] = getattr(self, name).copy()
            changed[name][at] = values
        return replace(self, **changed, words=tuple(dict.fromkeys((*self.words, *found.words))))

    def applied(self, scan: Scan) -> Scan:
        """The same frames with these exposures; `InputError` for another number of frames."""
        require(
            len(scan) == len(self.rotations),
            f"the geometry is that of {len(self.rotations)} frames, but the scan has {len(scan)}; take its run's.",
        )
        planned = scan.exposures
        scales = self.pixel_sizes / planned.views.pitch
        views = replace(planned.views, rotations=self.rotations, shifts=self.shifts, scales=scales)
        return scan.taken(replace(planned, views=views, distance=self.distance))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, which `from_dict` takes."""
        return {
            each.name: list(value) if isinstance(value := getattr(self, each.name), tuple) else value.tolist()
            for each in fields(self)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Geometry:
        """The geometry of `as_dict`; `InputError` for anything else."""
        with as_written("the geometry of a run", "what reconstruct wrote"):
            read: dict[str, Any] = {each.name: values[each.name] for each in fields(cls)}
            read |= {name: tuple(values[name]) for name in TEXTS}
            return cls(**read)

    def lines(self) -> list[str]:
        """The result in two sentences, and what stayed as planned."""
        said = f"geometry ({', '.join(self.refined)} refined), rms of the changes:"
        for name, at in (("training frames", ~self.held_out), ("held-out frames", self.held_out)):
            if at.any():
                root = np.sqrt(np.square(self.changes[at]).mean(0))
                shift, across = np.sqrt((root[0:4].reshape(2, 2) ** 2).mean(1))
                left = [np.sqrt(np.square(part[at]).mean()) for part in (self.before, self.after)]
                said += (
                    f" {name} {shift:.3f} pixels, {across:.3f}° across the beam, {root[4]:.3f}° about it, "
                    f"{root[5]:.2%} of the distance, {root[6]:.2%} of the magnification "
                    f"(unexplained {left[0]:.3f} → {left[1]:.3f});"
                )
        return [said.rstrip(";"), *self.words]


def wanted(names: str, uncertain: PosePrior) -> PosePrior:
    """`uncertain` with only what `names` says, of `REFINED` with commas between; errors: `InputError`."""
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in REFINED]
    require(
        not unknown,
        f"--refine must be made of {', '.join(REFINED)}, with commas between, but it says {', '.join(unknown)!r}; "
        "correct it.",
    )
    idle = [name for name in chosen if getattr(uncertain, REFINED[name]) == 0]
    require(not idle, f"--refine asks for {', '.join(idle)}, whose uncertainty is 0; make it larger, or leave it out.")
    return replace(uncertain, **{field: 0.0 for name, field in REFINED.items() if name not in chosen})
