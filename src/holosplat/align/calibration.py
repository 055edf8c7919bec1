"""`calibrate`: frames of a body of known shape in, exposures out, with errors and what the frames cannot tell."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import torch

from ..checks import InputError, require
from ..geometry import Views
from ..matter import Known, MaterialPrior
from ..mesh import TriangleMesh
from ..model import Alignment, Instrument
from ..optics.background import LightOptions
from ..optics.retrieval import paganin
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..ranges import MOST, Natural, Within, checked_dataclass
from ..scan import Exposures, Scan
from .derivatives import NUMBERS, changes, header, line, moved_onto, rms_of, unexplained
from .initial_geometry import retrieved, shifts_by_mass
from .phantom import STEPS, Linear, Phantom, find_beads, linearised, placed, solved
from .poses import DISTANCE, FLUX, SHIFT, TURN, Blur, PosePrior, aligned
from .views import EVEN_OR_NOT, KINDS, in_even_light

UNTOLD = 0.5
"""Standard error, as a share of what was expected, from which on frames do not tell a number."""
FREE_PX = 100.0
"""Standard deviation of a bead's place [pixels] and of a phantom's: it is not known at all."""
FINER = 2
"""Wave samples a pixel beside those that fringes need, in frames and not in their derivatives: faces that are seen
edge-on are sharper than fringes."""
FAINT = 0.1
"""Share of a view's greatest thickness below which it counts as none: much faint air would pull centres of mass."""
STILL = 0.05
"""A step of so many of `STEPS` at most is the last on its pixels: 0.0025 pixels, 0.003°."""
NAMES = {"shift": "shifts", "angle": "turns across the beam", "roll": "roll", "distance": "distance"}
"""The kinds of numbers in words."""


@checked_dataclass
class CalibrationOptions:
    """How a calibration proceeds."""

    uncertain: PosePrior = field(default_factory=lambda: PosePrior(5.0, 2.0, 2.0, 0.05))
    """What is not known of each view, and by how much."""
    pixel: Annotated[float, Within(0, 0.2)] = 0.0
    """Standard deviation of the pixel size, as a share of it (0: it is known)."""
    rounds: Natural = 8
    """Gauss–Newton steps on each size of pixels, at most."""
    blur: Blur = 1.0
    """Frames are compared after a Gaussian of this standard deviation [pixels]."""
    least_side: Annotated[int, Within(8, MOST)] = 24
    """Pixels along a frame's shorter side on the largest pixels, on which a first pose is looked for."""
    most_pixels: Natural = 400_000
    """Pixels of all frames, on the smallest pixels: larger frames are binned, and shifts found to a part of that."""

    retrieval: int = 20
    """Steps of the phase retrieval that a first place needs; 0: Paganin's filter, which will do without noise."""

    def __post_init__(self) -> None:
        require(
            self.uncertain.magnification == 0, "calibrate finds one pixel size of all views; leave magnification 0."
        )

    def bins(self, count: int, shape: tuple[int, int]) -> list[int]:
        """Sizes of pixels, the largest first."""
        sizes = [1]
        while count * shape[0] * shape[1] / sizes[-1] ** 2 > self.most_pixels:
            sizes = [2 * sizes[-1]]
        while min(shape) // (2 * sizes[-1]) >= self.least_side:
            sizes.append(2 * sizes[-1])
        return sizes[::-1]


DEFAULT = CalibrationOptions()


@dataclass(frozen=True)
class Calibrated:
    """The calibrated poses of V views.

    exposures: those of the scan, corrected; changes, errors: [V, 7] of the plan, as in `AlignedViews`
    pixel_size: [m], and its standard error as a share of it, 0 where it was known
    phantom: where its bodies are, in the object frame
    left: [V] rms of what is unexplained of each frame, as a share of its contrast; words: what was not determined
    """

    exposures: Exposures
    changes: np.ndarray
    errors: np.ndarray
    pixel_size: tuple[float, float]
    phantom: Phantom
    left: np.ndarray
    words: tuple[str, ...]

    def lines(self) -> list[str]:
        """The result in words, and a table of the views."""
        size, doubt = self.pixel_size
        pixel = f"pixel {1e6 * size:.5g} µm ± {doubt:.2%}; " if doubt else ""
        return [
            f"{pixel}{len(self.phantom)} {'beads' if self.phantom.free else 'body'}; unexplained share of the contrast "
            f"{float(np.sqrt(np.square(self.left).mean())):.4f}",
            *self.words,
            header("view", 3, "distance"),
            *(
                line(v, change, error, 3, f"{change[5]:+.2%} ± {error[5]:.2%}")
                for v, (change, error) in enumerate(zip(self.changes, self.errors))
            ),
        ]


def calibrate(
    scan: Scan,
    prior: MaterialPrior,
    body: TriangleMesh | float,
    options: CalibrationOptions = DEFAULT,
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Progress = lambda stage, fraction: None,
) -> Calibrated:
    """Calibrate the poses of the views of `scan`, of one time, by a phantom of known shape and material.

    body: the phantom's closed mesh [m], in any pose, or the radius [m] of beads, however many there are and wherever
    they lie. All of it is in every field. A motion of the whole phantom changes no frame; it is chosen so that the mean
    turn and the mean shift are those planned. Errors: `InputError` for frames of several times, in contact, or of a
    material that is not known.
    """
    require(not scan.is_series, "calibrate needs frames of one time; choose one with --time-frame.")
    if not isinstance(prior, Known):
        raise InputError("calibrate needs the phantom's material, of known density; say it by --material.")
    scan = in_even_light(scan, light)
    search = _Search.begun(scan, prior, body, options, on_progress)
    for n, pixels in enumerate(search.bins):
        for done in range(options.rounds):
            before = search.numbers
            search.step(pixels)
            on_progress("calibration", (n + (done + 1) / options.rounds) / len(search.bins))
            moved = (search.numbers - before)[:, : len(STEPS)].abs() / torch.tensor(STEPS)
            if float(moved.max()) < STILL * pixels:
                break
    return search.found()


class _Search:
    """A calibration in progress: numbers [V, 8] of the views beside the plan, of smallest pixels, and the phantom."""

    def __init__(self, scan: Scan, prior: Known, phantom: Phantom, options: CalibrationOptions) -> None:
        self.scan, self.material, self.phantom, self.options = scan, prior.material, phantom, options
        self.bins = options.bins(len(scan), scan.views.shape)
        self.numbers = torch.zeros(len(scan), len(NUMBERS), dtype=torch.float64)
        self.size = 0.0
        self.errors, self.size_error = np.zeros((len(scan), FLUX)), 0.0
        self.left = np.zeros(len(scan))

    @classmethod
    def begun(
        cls, scan: Scan, prior: Known, body: TriangleMesh | float, options: CalibrationOptions, on_progress: Progress
    ) -> _Search:
        """With shifts by centres of mass, and a phantom near where it is, by its shadows, or beads by a volume."""
        if isinstance(body, TriangleMesh):
            on_progress("first pose", 0.0)
            pixels = options.bins(len(scan), scan.views.shape)[0]
            coarse = scan.binned(pixels)
            phantom, shifts = placed(Phantom.of_mesh(body), _thickness(coarse, prior, options), coarse.views)
            search = cls(scan, prior, phantom, options)
            search.numbers[:, SHIFT] = torch.from_numpy(shifts * pixels)
            return search
        on_progress("beads", 0.0)
        pixels = options.bins(len(scan), scan.views.shape)[-1]
        fine = scan.binned(pixels)
        thickness = _thickness(fine, prior, options)
        shifts = shifts_by_mass(thickness, fine.views)
        views = replace(fine.views, shifts=fine.views.shifts + shifts * fine.views.pixel_size)
        centres = find_beads(torch.from_numpy(thickness).float(), views, body)
        if len(centres) == 1:
            options = replace(options, uncertain=replace(options.uncertain, angle=0.0, roll=0.0))
        search = cls(scan, prior, Phantom.of_beads(centres, body), options)
        search.numbers[:, SHIFT] = torch.from_numpy(shifts * pixels)
        return search

    def take(self, views: Views) -> None:
        """The poses of `views`; distances stay."""
        planned = self.scan.exposures
        found = changes(replace(planned, views=views), planned)
        self.numbers[:, SHIFT] = torch.from_numpy(found[:, :2])
        self.numbers[:, TURN] = torch.from_numpy(np.deg2rad(found[:, 2:5]))

    def exposures(self, planned: Exposures) -> Exposures:
        """Planned exposures, on pixels of any size, corrected by the numbers as they are now."""
        alignment = aligned(self.numbers, planned.views.pixel_size / self.scan.views.pixel_size)
        found, larger = alignment.exposures(planned), float(np.exp(self.size))
        views = replace(found.views, pitch=found.views.pitch * larger, shifts=found.views.shifts * larger)
        return replace(found, views=views)

    def step(self, pixels: int) -> None:
        """One step of all numbers on pixels `pixels` times larger, and the phantom moved with the mean of the views."""
        scan = self.scan.binned(pixels)
        exposures = self.exposures(scan.exposures)
        uncertain, pixel = self.options.uncertain, self.options.pixel
        samples = fringe_sampling(scan.exposures)
        found = linearised(self.phantom, exposures, self.material, samples, pixel > 0)
        if pixels == self.bins[-1]:
            finer = Instrument(exposures, samples + FINER)
            lines = self.phantom.surfaces(self.material, exposures.views.pixel_size).project(finer.poses)
            found = replace(found, frames=finer.frames(lines).detach().double())
        lit = self.numbers[:, FLUX].exp()[:, None, None]
        found = Linear(lit * found.frames, lit[:, None] * found.of_views, lit * found.of_all)
        scales = torch.ones(len(NUMBERS), dtype=torch.float64)
        scales[SHIFT] = pixels
        of_views = uncertain.deviations() / scales
        of_views[DISTANCE] = uncertain.distance if exposures.distance.all() else 0.0
        places = torch.zeros(self.phantom.unknowns, dtype=torch.float64)
        sizes = torch.full((int(pixel > 0),), self.size, dtype=torch.float64)
        expected = torch.cat([places + FREE_PX, torch.full_like(sizes, pixel)])
        frames = scan.measured
        now = (self.numbers / scales, torch.cat([places, sizes]))
        after = solved(frames, found, now, (of_views, expected), self.options.blur)
        self.numbers = after.of_views * scales
        if self.phantom.free:
            by = after.of_all[: len(places)].reshape(-1, 3).numpy() * exposures.views.pixel_size
            self.phantom = self.phantom.shifted(by)
        deviations = after.covariances.diagonal().clamp_min(0).sqrt()
        own = (deviations[len(deviations) - self.numbers.numel() :].reshape(self.numbers.shape) * scales).numpy()
        self.errors = own[:, :FLUX] * np.array([1, 1, *[np.rad2deg(1)] * 3, 1, 1])
        self.size_error = float(deviations[len(places)]) if self.options.pixel > 0 else 0.0
        self.left = rms_of(unexplained(frames, found.frames))
        if pixel > 0:
            self.size = float(after.of_all[-1])
        self._centre()

    def _centre(self) -> None:
        """The motion that all views share goes to the phantom: `x_lab = R x - s` stays what it is."""
        planned = self.scan.exposures
        alignment = Alignment(self.numbers[:, TURN], self.numbers[:, SHIFT])
        now = alignment.exposures(planned).views
        then = moved_onto(now, planned.views)
        turn = then.rotations[0].T @ now.rotations[0]
        design = then.rotations[:, :2].reshape(-1, 3)
        by = np.linalg.lstsq(design, (then.shifts - now.shifts).reshape(-1), rcond=1e-9)[0]
        self.phantom = self.phantom.moved(turn, by * float(np.exp(self.size)))
        self.take(then)

    def found(self) -> Calibrated:
        """The estimates in words, and those that the frames do not determine."""
        exposures = self.exposures(self.scan.exposures)
        words = list[str]()
        if len(self.phantom) == 1 and self.phantom.free:
            words.append("one bead looks the same from all sides: turns and roll are as planned, the frames tell none")
        for kind, places in KINDS.items():
            expected = getattr(self.options.uncertain, kind)
            untold = [str(v) for v in range(len(self.scan)) if (self.errors[v, list(places)] > UNTOLD * expected).any()]
            if expected > 0 and untold:
                which = "any view" if len(untold) == len(self.scan) else f"views {', '.join(untold)}"
                words.append(f"{NAMES[kind]}: not told by the frames for {which}; near the plan")
        size = self.scan.views.pixel_size * float(np.exp(self.size))
        compared = replace(exposures, views=replace(exposures.views, pitch=self.scan.views.pitch))
        return Calibrated(
            exposures,
            changes(compared, self.scan.exposures),
            self.errors,
            (size, self.size_error),
            self.phantom,
            self.left,
            tuple(words),
        )


def _thickness(scan: Scan, prior: Known, options: CalibrationOptions) -> np.ndarray:
    """Retrieved thickness [V, H, W] [m], without what is faint."""
    if options.retrieval:
        thickness = retrieved(scan, prior.material, options.retrieval)
    else:
        thickness = paganin(torch.from_numpy(scan.frames), scan.exposures, *prior.material, missing=scan.gaps)
    found = thickness.double().numpy()
    return np.where(found > FAINT * found.max(axis=(1, 2), keepdims=True), found, 0.0)
