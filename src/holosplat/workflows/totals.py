"""The total δ of a run by the frames that were fitted, in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import torch

from ..checks import as_written
from ..fit.residuals import Prediction
from ..frames import evenly
from ..geometry import Grid
from ..matter import MaterialPrior
from ..methods import Task
from ..methods.modulation import DOUBTFUL, RATIO_SHARE, Total, total_delta
from ..methods.spherical import ProfileErrors, SphericalFit
from ..methods.uncertain import Determined
from ..methods.volume import SmoothStage, SmoothVolume, binning
from ..optics.noise import NoiseModel
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from ..units import in_percent

MOST_VIEWS = 16
"""Most views for the total, evenly chosen: beyond these, errors of shapes and voxels dominate."""
MOST_VOXELS = 1_000_000
"""Frames are binned rather than having more voxels than this: about 100 × 100 pixels, which takes seconds."""
TOLD = 0.1
"""Standard error, as a share, up to which a total is a measurement; beyond it an interval is all there is."""
WIDE = 2.0
"""Standard errors to either side in such an interval: the truth is in 19 of 20 of them."""


@dataclass(frozen=True)
class TotalMatter:
    """The total of a run. quantity: of which index; value, error: it and its standard error [m³], None for empty
    volumes; held: what the volume of the reconstruction has of it [m³]; words: all this in a line; profile: errors of
    centre and profile of spherical matter"""

    quantity: Literal["δ", "β"]
    value: float | None
    error: float | None
    held: float
    words: str
    profile: ProfileErrors | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_dict` reads them."""
        return {
            "quantity": "delta" if self.quantity == "δ" else "beta",
            "value_m3": self.value,
            "standard_error_m3": self.error,
            "held_m3": self.held,
            "words": self.words,
            **({"profile": self.profile.as_dict()} if self.profile else {}),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TotalMatter:
        """The total that `as_dict` described; `InputError` for anything else."""
        with as_written("a total", "what reconstruct wrote"):
            number, error = (
                (None if (v := values[k]) is None else float(v)) for k in ("value_m3", "standard_error_m3")
            )
            quantity: Literal["δ", "β"] = "δ" if values["quantity"] == "delta" else "β"
            profile = ProfileErrors.from_dict(values["profile"]) if "profile" in values else None
            held = float(values["held_m3"])
            return cls(quantity, number, error, held, str(values["words"]), profile)


def total_of_run(said: Prediction, frames: Scan, task: Task, constants: tuple[Determined, ...] = ()) -> TotalMatter:
    """The total δ by what a run says of the `frames` that it was fitted to, with the knowledge and noise of its `task`.

    constants: what was uncertain; the doubt of δ/β is that of its interval, or `RATIO_SHARE` where it was estimated.

    Where the frames show no refraction and nothing is known, it is the total β.
    """
    found = cast(Stored, said.object)
    quantity: Literal["δ", "β"] = "δ" if task.delta_told else "β"
    grid = Grid.of_views(frames[[0]].binned(binning(frames, MOST_VOXELS)).views)
    volume = found.voxelise(grid)
    held = float(np.sum(volume.delta, dtype=np.float64)) * math.prod(grid.voxel_size)
    sign, against = found.matter.channels[0].sign, task.prior.against
    if task.prior.spherical and isinstance(found, VoxelGrid) and bool(found.values.any()):
        fit = SmoothStage(SmoothVolume()).fit(task, found)
        assert isinstance(fit, SphericalFit)
        error, profile = fit.errors()
        words = f"total {quantity} against {against} {held:.3g} m³ ± {error:.2g} m³, of spherical matter"
        return TotalMatter(quantity, held, error, held, words, profile)
    if task.prior.two_sided:
        words = (
            f"total {quantity} against {against} {held:.3g} m³ in the volume; of matter on both sides no error is known"
        )
        return TotalMatter(quantity, None, None, held, words)
    if sign * held <= 0:
        return TotalMatter(quantity, None, None, held, f"total {quantity}: none, for the volume is empty")
    chosen = evenly(len(frames), MOST_VIEWS)
    factor = binning(frames, MOST_VOXELS)
    few = frames[chosen]
    predicted = None if _imaged_as_voxels(said, frames, factor) else _predicted(said, few, chosen).binned(factor)
    noise = (task.noise if len(frames) == len(task.scan) else NoiseModel.of_frames(frames.measured))[
        torch.from_numpy(chosen)
    ].binned(factor)
    shown = None if predicted is None else torch.from_numpy(predicted.frames)
    doubt = ratio_doubt(task.prior, constants)
    total = total_delta(found, few.binned(factor), noise, shown, doubt, volume)
    material = task.prior.materials[0].delta if len(task.prior.materials) == 1 else None
    return TotalMatter(
        quantity,
        total.value,
        total.error,
        total.held,
        in_words(total, quantity, material, doubt < DOUBTFUL, against),
    )


def ratio_doubt(prior: MaterialPrior, constants: tuple[Determined, ...]) -> float:
    """Standard error of δ/β as a share: a quarter of its interval of 95 %."""
    for each in constants:
        if each.name == "delta_beta":
            return min(RATIO_SHARE, 0.25 * abs(math.log(each.high / each.low)))
    return 0.0 if prior.fixes_ratio else RATIO_SHARE


def in_words(
    total: Total, quantity: str, delta: float | None = None, ratio_known: bool = True, against: str = ""
) -> str:
    """A total in a line; delta: of the one known material, whose volume is then said too; against: the medium."""
    named = f"total {quantity}" + (f" against {against}" if against else "")
    held = f"; the volume itself holds {total.held:.3g}" if abs(total.held - total.value) > WIDE * total.error else ""
    if total.share <= TOLD:
        volume = "" if delta is None else f" ({total.value / delta:.3g} m³ of the material)"
        return f"{named} {total.value:.3g} m³ ± {in_percent(total.share)}{volume}{held}"
    sign = math.copysign(1.0, total.held)
    size, reach = sign * total.value, WIDE * total.error
    low, high = sorted((sign * max(0.0, size - reach) + 0.0, sign * (max(0.0, size) + reach)), key=abs)
    volume = "" if delta is None else f" ({low / delta:.2g} to {high / delta:.2g} m³ of the material)"
    cannot = "the frames cannot tell it" if ratio_known else "the frames cannot tell it without the ratio δ/β"
    return f"{named}: {cannot}; between {low:.2g} and {high:.2g} m³{volume}{held}"


def _imaged_as_voxels(said: Prediction, frames: Scan, factor: int) -> bool:
    """Whether whitened frames see the object as its own model does: one material on voxels of a pixel, even light."""
    found = said.object
    plain = factor == 1 and said.alignment is None and said.light is None
    if not (plain and isinstance(found, VoxelGrid) and found.matter.single):
        return False
    return bool(np.allclose(found.grid.voxel_size, frames.views.finest, rtol=1e-6))


def _predicted(said: Prediction, few: Scan, chosen: np.ndarray) -> Scan:
    """The chosen frames as the run's own model predicts them, view by view to bound memory."""
    with torch.no_grad():
        frames = torch.cat([said.view(int(i)).frames().cpu() for i in chosen])
    return Scan(frames.float().numpy(), few.exposures, few.is_test)
