"""The start of a reconstruction: one material's occupancy from a few holograms, on voxels.

Nonlinear phase retrieval of each view, then total-variation tomography with the occupancy kept in [0, 1], then a few
corrections that make the volume agree with the holograms themselves: single-view retrieval leaves errors at low
frequencies that only consistency between views can mend.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..backends import Backend, device, resolve
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..memory import memory_kept
from ..model import Instrument, SolvedLight
from ..optics.background import Light
from ..optics.noise import NoiseModel, noise_share
from ..optics.retrieval import Tikhonov, absorption_alone, tikhonov
from ..optics.retrieval.bounded import FIXED, MODEL_ERROR, NOWHERE, Leaves
from ..optics.retrieval.spectra import Raster, filtered, radian, response, spectra, surrounded
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..projectors.voxels import projector_for
from ..ranges import Metres, Natural, Weight, checked_dataclass
from ..scan import Scan
from .beyond import Margins, carried_on, columns_beyond, rows_beyond, unseen_rays
from .primal_dual import PrimalDual
from .rays import frames_of, photons_left, rays_of, refined
from .tomography import TotalVariation, tv_solver

IN_NOISE = 1.0
"""Weight of total variation in rounds of agreement with noisy frames [pixels of path length]: 0.3 left up to a half
more of the volume's error, and 2 about as much (looked at once; no script keeps it)."""

Wanted = Callable[[Tensor, Grid], bool]
"""Whether the volume [Z, Y, X] that tomography has found, and its grid, are to be made to agree with the holograms."""


def _always(volume: Tensor, grid: Grid) -> bool:
    return True


@checked_dataclass
class HolographicTV:
    """Options of the start: phase retrieval, total variation, and agreement with the holograms."""

    retrieval: Natural = 60
    """Steps of the phase retrieval."""
    iterations: Natural = 160
    """Primal–dual steps on the retrieved thickness."""
    weight: Weight = 0.3
    """Weight of total variation while the volume is made to agree with the holograms, in pixels of path length."""
    relit: int = 3
    """Rounds at most in which uneven light is found anew beside the volume; the first does most."""
    corrections: int = 6
    """Rounds of agreement (0: none)."""
    inner: int = 12
    """Primal–dual steps a round, for `few_views` or more."""
    few_views: int = 8
    """With fewer views than this a round has more steps: total variation has more to fill in."""
    settling: int = 2
    """Rounds after which misfits are compared: in the first ones the solver finds its dual variables."""
    noisy: Weight = 0.35
    """Share of the frames' contrast that is noise from which on there are no rounds: the volume would agree with it."""
    refine: int = 0
    """Voxels along a pixel's edge in the rounds (0: as the first fringe needs)."""
    max_voxels: Natural = 70_000_000
    """Coarser voxels rather than more than this many."""
    upper: Weight = 1.0
    """Bound of the occupancy (0: none)."""
    two_sided: bool = False
    """Whether the occupancy may be below zero, of matter on both sides of its medium; a run takes what is known of the
    matter, or decided."""
    lacking: bool = False
    """Whether frames show what a result lacks, such as frames over those of known bodies (`bounded_estimate`)."""
    still_light: int = 0
    """Half waves across a frame up to which light that is the same in all frames, such as what a missing flat field has
    left, is unknown and found beside the matter (0: there is none). Its mean is taken to be right, for in few views it
    could pass for matter everywhere. A known material, whose bound tells matter from light, finds it best. There are
    then no rounds."""
    misfit: Weight = 0.0
    """Weight of total variation on the retrieved thickness as a multiple of what 60 steps leave unexplained (rms),
    where that is more than half a pixel: about 2 where frames have systematic errors (0: always half a pixel)."""
    inside: Metres = 0.0
    """Distance from the axis within which matter lies [m], such as the inner radius of a tube (0: anywhere)."""
    beyond: bool = True
    """Whether a volume without a bound has rows of its own above and below the frames where matter goes on there; else
    it goes on as in its outermost ones."""
    beside: Weight = 0.0
    """Width of the matter at either side of the frames that is an unknown (interior tomography), as a share of theirs
    (0: there is none). With 0.5 sparse matter, such as a crack, gains most. Of thick soft matter frames do
    not say how much lies inside, and its error may grow."""
    backend: Backend = "auto"
    """What computes it."""

    def in_noise(self) -> HolographicTV:
        """The same with rounds of agreement in noise, too: twice as many, and a weight of total variation beside which
        what noise leaves in them is small. Wiener's inverse lets half a pixel of it through, however much there is."""
        return replace(self, noisy=1.0, weight=max(self.weight, IN_NOISE), corrections=2 * self.corrections)


def holographic_tv(
    scan: Scan,
    material: DeltaBeta,
    options: HolographicTV,
    on_progress: Progress,
    light: Light | None = None,
    wanted: Wanted = _always,
    lines: Tensor | None = None,
) -> tuple[Tensor, Grid]:
    """Occupancy [Z, Y, X] of `material` (δ and β of any sign) from the frames of `scan`, and its grid.

    `on_progress(stage, fraction)` is called between pieces of work. light: uneven light that the frames were divided
    by; what is left of it is found anew in each round of agreement, beside what the volume predicts. wanted: asked
    before the rounds, unless there are none. lines: what `retrieved` gave for these frames, where they are in even
    light and matter does not go on beyond them.
    """
    with memory_kept():
        options = replace(options, backend=resolve(options.backend))
        volume, grid = _holographic_tv(scan, material, options, on_progress, light, wanted, lines)
        return volume.cpu(), grid


def retrieved(
    scan: Scan,
    material: DeltaBeta,
    options: HolographicTV,
    on_progress: Progress,
    light: Light | None = None,
    leaves: Leaves = NOWHERE,
) -> Tensor:
    """Thickness [V, H, W] of `material` [m], which phase retrieval finds in every view by itself; leaves: whether
    matter goes on above and below the frames, and at their sides."""
    backend, noise = resolve(options.backend), correlated(light)
    how = Tikhonov(iterations=options.retrieval, backend=backend, leaves=leaves, noise=noise, lacking=options.lacking)
    known = {"options": how, "missing": scan.gaps, "on_progress": partial(on_progress, "phase retrieval")}
    known["two_sided"] = options.two_sided
    return tikhonov(torch.from_numpy(scan.frames), scan.exposures, *material, **known)


def agreed(
    scan: Scan,
    material: DeltaBeta,
    start: Tensor,
    options: HolographicTV,
    on_progress: Progress,
    light: Light | None = None,
) -> tuple[Tensor, Grid]:
    """Occupancy [Z, Y, X] after rounds of agreement that begin with `start`, on voxels of a pixel, and its grid.

    The voxels are those of `Grid.of_views`; rounds are made in any noise. Else as `holographic_tv`.
    """
    with memory_kept():
        options = replace(options, backend=resolve(options.backend))
        views = scan.views.in_units_of(scan.views.finest)
        projector = projector_for(Grid.of_views(views), views, options.backend)
        there = start.to(device(options.backend))
        begun = PrimalDual(projector, there, options.weight, options.upper or None, backend=options.backend)
        beyond = _leaving(begun.volume, scan, material, options)
        volume, grid = _agree(scan, material, begun, options, 1, on_progress, light, beyond)
        return volume.cpu(), grid


def _holographic_tv(
    scan: Scan,
    material: DeltaBeta,
    options: HolographicTV,
    on_progress: Progress,
    light: Light | None,
    wanted: Wanted,
    lines: Tensor | None,
) -> tuple[Tensor, Grid]:
    noise = noise_share(scan.measured)
    scan, refine, factor = _working_resolution(scan, options)
    light = light if light is None or factor == 1 else light.part(torch.arange(len(scan)), factor)
    if light is None or light.background is None or options.still_light:  # still light is an unknown of tomography
        solver = _tomography(scan, material, options, on_progress, light, lines if factor == 1 else None)
    else:
        scan, light, solver = _settled(scan, material, options, on_progress, light)
    alone = absorption_alone(scan.exposures, material.beta / material.delta)  # then retrieval left nothing to correct
    beyond = _leaving(solver.volume, scan, material, options)
    field = _field(scan, solver).taller(beyond)
    volume, grid = carried_on(solver.volume, beyond), Grid.of_views(field)
    free = options.still_light or options.two_sided  # no bound holds what rounds add at low frequencies
    none = options.corrections == 0 or free or noise > options.noisy or alone.all()
    if none or not wanted(volume.cpu(), grid):
        return volume, grid
    return _agree(scan, material, solver, options, refine, on_progress, light, beyond)


def _leaving(volume: Tensor, scan: Scan, material: DeltaBeta, options: HolographicTV) -> int:
    """Rows above and below the frames into which a volume [Z, Y, X] that ends with them is carried on as it is in its
    outermost ones, where matter goes on there: its waves would else have the fringes of an end."""
    ends = volume.shape[1] == scan.views.shape[0] and options.still_light == 0
    return rows_beyond(volume, scan, material.beta / material.delta) if ends else 0


def _tomography(
    scan: Scan,
    material: DeltaBeta,
    options: HolographicTV,
    on_progress: Progress,
    light: Light | None,
    lines: Tensor | None = None,
) -> PrimalDual:
    """Phase retrieval of each view and total variation: the solver, on voxels of one pixel.

    Where its volume has matter at the top or at the bottom, both are done anew with matter beyond the frames; but not
    where a bound says how much of it there is (`_leaving`). So they are with what lies at the
    sides, where that is an unknown (`beside`): its rays have no weight.
    """
    if lines is None:
        lines = retrieved(scan, material, options, on_progress, light)
    solver = _volume_of(lines, scan, material, options, on_progress)
    free = options.beyond and options.still_light == 0
    rows = rows_beyond(solver.volume, scan, material.beta / material.delta) if free and options.upper == 0 else 0
    columns = columns_beyond(scan.views, options.beside) if free else 0
    if not (rows or columns):
        return solver
    lines = retrieved(scan, material, options, on_progress, light, leaves=(rows > 0, columns > 0))
    return _volume_of(carried_on(lines, rows, columns), scan, material, options, on_progress)


def correlated(light: Light | None) -> NoiseModel | None:
    """The noise where it is known to be correlated, and what is not known of uneven light with it; None for white noise
    in even light, which the frames themselves tell."""
    if light is None or not (light.noise.has_grain or light.background is not None):
        return None
    return light.doubt


def _volume_of(
    lines: Tensor, scan: Scan, material: DeltaBeta, options: HolographicTV, on_progress: Progress
) -> PrimalDual:
    """Total variation on the thickness [V, H, W] of views, which may have rows and columns beyond the frames."""
    beyond = _margins(lines, scan)
    field, gaps = scan.views.padded(beyond), unseen_rays(scan, beyond)
    rays = rays_of(lines, field, Grid.of_views(field), options.backend, gaps)
    first = min(TotalVariation.first, options.iterations)
    known = {"still_light": options.still_light, "misfit": options.misfit, "two_sided": options.two_sided}
    wall = scan.exposures.wall
    inside = (options.inside or (0.0 if wall is None else wall.inside)) / scan.views.finest
    steps = TotalVariation(first=first, iterations=options.iterations - first, inside=inside, **known)
    weights = photons_left(lines, scan.exposures, material)
    return tv_solver(rays, options.upper or None, steps, partial(on_progress, "tomography"), options.backend, weights)


def _settled(
    scan: Scan, material: DeltaBeta, options: HolographicTV, on_progress: Progress, light: Light
) -> tuple[Scan, Light, PrimalDual]:
    """The frames in better light, that light, and their volume.

    Air does not say what the light is behind bodies. What it misses there passes for faint matter, but differs between
    views, so that no volume explains it all: the rest, at the light's frequencies, is light. Of all rounds the one
    counts whose volume and light explain the frames best; where noise hides the shadows of bodies that is the first.
    """
    assert light.background is not None
    measured = (torch.from_numpy(scan.frames) * light.factor()).float()
    known = scan.known(measured)
    samples = fringe_sampling(scan.exposures, voxels=1)
    instrument = Instrument(scan.exposures, samples, backend=options.backend)
    best, least, first = None, float("inf"), light.noise
    for _ in range(1 + options.relit):
        scan = replace(scan, frames=light.evened(measured).numpy())
        solver = _tomography(scan, material, options, on_progress, light)
        lines = refined(solver.lines(), samples) * scan.views.finest
        predicted = frames_of(instrument, lines, material).detach().cpu()
        after = light.settled(known, predicted)
        misfit = replace(after, noise=first).misfit(known, predicted)
        if best is not None and misfit >= least:
            break
        noise = NoiseModel.of_residuals(after.evened(known), predicted)
        best, least, light = (scan, light, solver), misfit, replace(after, noise=noise)
    assert best is not None
    return best


def _agree(
    scan: Scan,
    material: DeltaBeta,
    coarse: PrimalDual,
    options: HolographicTV,
    refine: int,
    on_progress: Progress,
    light: Light | None,
    carried: int = 0,
) -> tuple[Tensor, Grid]:
    """The volume after rounds of agreement with the holograms, on voxels `refine` times finer than pixels.

    It is `carried` on by so many rows of pixels above and below (`_leaving`).

    Each round runs the wave optics on the volume's projection, inverts what is missing from the frames, as far as
    their noise lets it be known (`Correction`), and gives the corrected projection to a few primal–dual steps. The
    round that agrees best is returned, for the iteration may diverge; the first ones, in which the solver finds its
    dual variables, do not count.
    """
    pitch = scan.views.finest
    field = _field(scan, coarse)
    beyond, views = _margins(coarse.volume, scan), field.in_units_of(pitch)
    unseen = unseen_rays(scan, beyond)
    unseen = None if unseen is None else refined(unseen.float(), refine).to(coarse.volume.device) > 0.5
    correction = Correction(scan, material, beyond[0], correlated(light))
    finer = math.ceil(fringe_sampling(scan.exposures, voxels=refine) / refine)
    instrument = Instrument(scan.exposures, refine * finer, backend=options.backend)
    frames = torch.from_numpy(scan.frames).to(instrument.device)
    gaps = None if scan.gaps is None else scan.gaps.to(instrument.device)
    beside = None if light is None or light.background is None else SolvedLight(light.background, frames, light.air)
    grid = Grid.of_views(views, refine)
    projector = projector_for(grid, views.refined(refine), options.backend)
    solver = coarse.on_finer(projector, refine, options.weight)
    inner = math.ceil(options.inner * max(1.0, options.few_views / len(scan)))
    best, least = solver.volume, float("inf")
    for done in range(options.corrections + 1):
        on_progress("agreement with the holograms", done / options.corrections)
        lines = solver.lines()
        there = carried_on(refined(lines, finer), carried * refine * finer)
        predicted = frames_of(instrument, there * pitch, material).detach()
        lit = predicted if beside is None else predicted * beside.factor(images=predicted)
        missing = frames - lit if gaps is None else (frames - lit).masked_fill(gaps, 0.0)
        misfit = float(missing.square().sum())
        if misfit < least or done <= options.settling:
            best, least = solver.volume.clone(), misfit
        if done < options.corrections:
            more = pad(correction(missing), (beyond[1], beyond[1]))
            solver.run(lines + refined(more / pitch, refine), inner, unseen)
    best, grid = carried_on(best, carried * refine), Grid.of_views(views.taller(carried), refine)
    return best, _in_metres(grid, pitch)


def _field(scan: Scan, solver: PrimalDual) -> Views:
    """The views with the rows and columns that the volume of `solver`, on voxels of a pixel, has beyond the frames."""
    return scan.views.padded(_margins(solver.volume, scan))


def _margins(array: Tensor, scan: Scan) -> Margins:
    """Rows and columns beyond the frames on either side, of a volume [Z, Y, X] or of images [V, H, W], on pixels."""
    rows, columns = ((n - seen) // 2 for n, seen in zip(array.shape[1:], scan.views.shape))
    return rows, columns


class Correction:
    """Thickness [V, H, W] in metres that explains what is missing from the frames, by Wiener's inverse of each view.

    The inverse is that of `optics.retrieval.spectra`, for the noise of the frames and the power expected of the phase:
    where noise hides a frequency, the views are not made to agree on it.
    """

    def __init__(self, scan: Scan, material: DeltaBeta, beyond: int = 0, noise: NoiseModel | None = None) -> None:
        exposures, frames = scan.exposures.optical, torch.from_numpy(scan.frames)
        self._exposures, self._radian = exposures, radian(exposures, material.delta)
        wide, _ = surrounded(frames, exposures)
        raster = Raster((wide.shape[-2], wide.shape[-1]), exposures.views.pixel_size)
        h = response(exposures, material.beta / material.delta, raster)
        known = spectra(frames, exposures, h, raster, noise, MODEL_ERROR, FIXED)
        self._inverse, self._beyond = known.inverse, beyond

    def __call__(self, missing: Tensor) -> Tensor:
        """The thickness, float32, for missing intensity [V, H, W]; and `beyond` rows more of it above and below."""
        wide, (views, rows, columns) = surrounded(missing + 1, self._exposures)
        room = min(self._beyond, rows.start)
        taller = (views, slice(rows.start - room, rows.stop + room), columns)
        inverse, radian = (factor.to(missing.device) for factor in (self._inverse, self._radian))
        found = (-filtered(wide, inverse)[taller] * radian).float()
        return carried_on(found, self._beyond - room)


def _working_resolution(scan: Scan, options: HolographicTV) -> tuple[Scan, int, int]:
    """The scan, binned if its voxels would be too many; its voxels and the frames' pixels along an edge."""
    refine = options.refine or fringe_sampling(scan.exposures)
    h, w = scan.views.shape
    while refine > 1 and w * w * h * refine**3 > options.max_voxels:
        refine -= 1
    factor = 1
    while w * w * h / factor**3 > options.max_voxels and factor < min(h, w):
        factor += 1
    return scan.binned(factor), refine, factor


def _in_metres(grid: Grid, pitch: float) -> Grid:
    size, origin = ([v * pitch for v in values] for values in (grid.voxel_size, grid.origin))
    return Grid(grid.shape, (size[0], size[1], size[2]), (origin[0], origin[1], origin[2]))
