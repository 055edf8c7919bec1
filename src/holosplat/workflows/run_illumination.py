"""The illumination of frames that a reconstruction is compared with, by the air of each frame; the fixed pattern: the
common factor of all frames beside their matter, where a flat field is missing; and the light of all projections of a
raw file, by their air: found on binned frames, given on whole ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch

from ..baselines import HolographicTV
from ..checks import InputError, require
from ..divided_light import DividedLight
from ..frames import block_means
from ..inference import ERRORS
from ..matter import MaterialPrior
from ..methods import Method, Task
from ..methods.cross_validation import predicted_frames
from ..methods.illumination import predicted_first, still_order
from ..optics.air import Box, find_air, has_air
from ..optics.background import FLUX, ORDER, Light, LightOptions
from ..optics.patterns import cosines, mean_light
from ..progress import Progress
from ..ranges import Within, checked_dataclass
from ..representations import Stored
from ..scan import Scan
from ..tables import from_table

EVEN = LightOptions("even")
"""Frames are compared as they are."""


def light_options_of(task: Task) -> LightOptions:
    """What a run assumes of other frames of its scan: smooth light if that of the training frames is uneven; other
    frames are taken to have the mean flux."""
    known = task.uneven and task.uneven.background
    return EVEN if known is None or known.is_flux else replace(task.light, kind="smooth")


def read_light_options(config: Mapping[str, Any], summary: Mapping[str, Any]) -> LightOptions:
    """The same of a run folder; older ones say nothing of light, which is then even."""
    said = str(summary.get("light", "even"))
    if said == "even" or said.startswith(("the same", FLUX)):
        return EVEN
    return replace(from_table(LightOptions, config.get("light", {}), "light"), kind="smooth")


def fixed_pattern_of(task: Task, method: Method, found: Stored, oversample: int) -> np.ndarray | None:
    """The light [H, W] that the frames of a run have in common, float32; None where they have none.

    It was divided out before (`prepared`), or is an unknown of `method`: then it is the residual of the frames.
    """
    if task.lit is not None and task.lit.still is not None:
        return task.lit.still.numpy().astype(np.float32)
    order = still_order(method)
    if not order:
        return None
    predicted = predicted_frames(task.scan.exposures, found, oversample)
    return mean_light(task.scan.measured, predicted, order).numpy().astype(np.float32)


def light_of(scan: Scan, assumed: LightOptions, still: np.ndarray | None = None) -> Light | None:
    """The light of all frames of `scan`, held-out ones too, by their air; None where it is even.

    The power of light at each number of half waves is estimated from all frames together; the light itself is each
    frame's own. A frame without air has its prior mean, even light; so have all frames where none has air.
    still: [H, W], beside that: what the training frames of the run have in common, and frames of this raster with them.
    """
    frames = scan.measured
    common = None if still is None or still.shape != scan.views.shape else torch.from_numpy(still).double()
    if common is not None:
        frames = (frames / common).float()
    smooth = assumed.kind != "even" and bool(assumed.air_of(frames).any())
    if not smooth and common is None:
        return None
    if smooth and scan.light is not None:
        return replace(Light.handed(frames, assumed, scan.light), still=common)
    found = Light.of(frames, assumed if smooth else EVEN)
    return None if found.background is None and common is None else replace(found, still=common)


FEWEST = 2
"""Least number of training frames: in one frame, light and matter cannot be separated."""


@checked_dataclass
class FixedPatternOptions:
    """Options of the estimate of a fixed pattern."""

    order: Annotated[int, Within(0, 32)]
    """Half waves across a frame up to which light changes, such as 4; its mean is taken to be right. 0: any pattern,
    pixel by pixel, which takes views enough for errors of the volume to differ from one to another."""
    inside: float = 0.0
    """Distance from the axis within which matter lies [m] (0: anywhere)."""
    misfit: float = 3.0
    """Weight of total variation, as `HolographicTV.misfit`; smooth light only."""
    iterations: int = 300
    """Steps of tomography."""


def estimate_fixed_pattern(
    scan: Scan, prior: MaterialPrior, options: FixedPatternOptions, on_progress: Progress
) -> np.ndarray:
    """The light [H, W], relative to the flat field, that the training frames of `scan` have in common.

    Their matter is made by phase retrieval and total variation, with an occupancy of at most one where `prior` knows
    the material; smooth light is an unknown of that. The light is then the geometric mean of measured over predicted
    frames: matter that turns is in other pixels in every frame, and averages out. What all frames show in the same
    pixels is taken for light, also of matter that is round about the axis and is not in the volume.

    Errors: `InputError` for fewer than `FEWEST` frames.
    """
    train = scan.train()
    require(len(train) >= FEWEST, f"still light needs at least {FEWEST} frames for training, but there is one.")
    how = HolographicTV(
        iterations=options.iterations if options.order else HolographicTV.iterations,
        still_light=options.order,
        misfit=options.misfit if options.order else 0.0,
        inside=options.inside,
        upper=prior.bound(1.0),
    )
    predicted = predicted_first(train, prior, how, on_progress)
    return mean_light(train.measured, predicted, options.order).float().numpy()


def flatfield_corrected(
    scan: Scan,
    prior: MaterialPrior,
    options: FixedPatternOptions,
    on_progress: Progress = lambda stage, fraction: None,
) -> Scan:
    """The scan with all frames, held-out ones too, divided by the fixed pattern of the training frames."""
    light = estimate_fixed_pattern(scan, prior, options, on_progress)
    said = {"still_light": f"{np.log(light).std():.2%} (rms), order {options.order}, divided out"}
    return scan.divided(light[None], said)


LONGEST = 128
"""Pixels along the longer side of the binned frames, at most."""
BESIDE = 0.05
"""Width of the left and the right border, as a part of a frame's."""
BRIGHTER = 0.02
"""Where a border is brighter than the frame's mean by this part, it shows air, or less matter than the middle."""


@dataclass(frozen=True)
class Look:
    """All projections at once: frames [V, h, w] of pixels `factor` times larger; shape: (H, W) of a whole one."""

    frames: np.ndarray
    factor: int
    shape: tuple[int, int]

    @classmethod
    def at(cls, frame: Callable[[int], np.ndarray], count: int) -> Look:
        """At `count` relative frames [H, W], `frame(i)` one at a time."""
        first = frame(0)
        factor = min(math.ceil(max(first.shape) / LONGEST), *first.shape)
        binned = np.stack([block_means(first if i == 0 else frame(i), factor) for i in range(count)])
        return cls(binned, factor, (first.shape[0], first.shape[1]))

    def air(self) -> float | None:
        """The median level of air in the frames that show some; None where none does."""
        frames = torch.from_numpy(self.frames)
        air = find_air(frames)
        levels = [float(frame[there].mean()) for frame, there in zip(frames, air) if has_air(there[None]).item()]
        return float(np.median(levels)) if levels else None

    def has_matter_beside_air(self) -> bool:
        """Whether the rest of most frames that show air is darker than it by more than it varies itself; else what
        passes for air may be smooth matter that fills the frames."""
        air = find_air(torch.from_numpy(self.frames)).numpy()
        pairs = [(f[there], f[~there]) for f, there in zip(self.frames, air) if there.any() and not there.all()]
        darker = [light.mean() - rest.mean() > ERRORS * light.std() for light, rest in pairs]
        return 2 * sum(darker) > len(self.frames)

    def has_bright_border(self) -> bool:
        """Whether the left or the right border is brighter than the frame, as where matter in the middle absorbs."""
        width = max(1, round(BESIDE * self.frames.shape[2]))
        sides = np.stack([self.frames[:, :, :width], self.frames[:, :, -width:]]).mean(axis=(2, 3)).max(axis=0)
        return bool(np.median(sides / self.frames.mean(axis=(1, 2))) > 1 + BRIGHTER)


@dataclass(frozen=True)
class AirLight:
    """coefficients [V, (K + 1)²] of smooth light; airless: how many projections had no air, and take the mean light;
    doubt: what is not known of it, of whole frames."""

    coefficients: np.ndarray
    airless: int
    doubt: DividedLight

    @classmethod
    def of(cls, look: Look, air: Sequence[Box] = (), asked: bool = False) -> AirLight | None:
        """Of the projections in `look`; None where none of them has air, or all is even.

        air: boxes of it, or nothing to find it; asked: whether even light counts, too. Errors: `InputError` for boxes
        outside the frames.
        """
        boxes = tuple(_shrunk(box, look.factor, look.shape) for box in air)
        options = LightOptions("smooth" if asked else "auto", boxes)
        frames = torch.from_numpy(look.frames)
        usable = has_air(options.air_of(frames))
        if not bool(usable.any()):
            return None
        found = Light.of(frames, options)
        if found.background is None:
            return None
        usable = has_air(found.air)
        coefficients = found.background.coefficients
        coefficients = torch.where(usable[:, None], coefficients, coefficients[usable].mean(dim=0))
        known, count = found.background, len(coefficients)
        variances = known.variances.expand(count, -1)
        left = torch.where(usable[:, None, None], known.covariances, torch.diag_embed(variances))
        powers = known.powers.numpy() * look.factor**2
        doubt = DividedLight(left.numpy(), variances.numpy(), powers, look.shape)
        return cls(coefficients.numpy(), int((~usable).sum()), doubt)

    def factor(self, number: int, shape: tuple[int, int]) -> np.ndarray:
        """The light [H, W] of projection `number`."""
        rows, columns = (cosines(n, ORDER, "cpu").numpy() for n in shape)
        return np.exp(rows.T @ self.coefficients[number].reshape(ORDER + 1, ORDER + 1) @ columns)


def _shrunk(box: Box, factor: int, shape: tuple[int, ...]) -> Box:
    """A box in binned pixels, of those that lie in it whole, one at least."""
    top, bottom, left, right = box
    inside = 0 <= top < bottom <= shape[0] and 0 <= left < right <= shape[1]
    if not inside:
        raise InputError(
            f"a box of --air must lie within {shape[0]} rows and {shape[1]} columns, its ends after its beginnings, "
            f"but it is rows {top} to {bottom}, columns {left} to {right}; correct it."
        )
    starts = [math.ceil(n / factor) for n in (top, left)]
    ends = [max(start + 1, end // factor) for start, end in zip(starts, (bottom, right))]
    most = [n // factor for n in shape]
    starts, ends = ([min(n, m - k) for n, m in zip(side, most)] for side, k in ((starts, 1), (ends, 0)))
    return starts[0], ends[0], starts[1], ends[1]
