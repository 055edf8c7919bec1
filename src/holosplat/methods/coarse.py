"""Large frames of closed bodies: surfaces on coarse pixels first, and from there to finer ones.

A volume costs the cube of the pixels across it, and the surface of a body their square. So bodies are found on frames
binned to few pixels, as surfaces, which hold edges far finer than these pixels; on finer ones a few steps then do. What
coarse pixels cannot show (bodies too small for them) is seen by what it leaves unexplained in the fine ones, and such
frames start on their own pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..checks import at_least
from ..matter import DeltaBeta
from ..optics.noise import noise_levels
from ..ranges import Pixels, Share, Weight, checked_dataclass
from ..representations import GaussianCloud, SurfaceMesh
from ..representations.isosurface import edge_lengths, loop_subdivision
from ..scan import Scan
from .cross_validation import MissingMatter
from .method import Task, run_quietly
from .surface_fit import SurfaceFit, SurfaceOptions, frames_of, surface_fit

STAGE = "coarse pixels"
FEWEST_ROWS = 32
"""Rows and columns that binned frames keep, at least: fewer show no body."""
DOUBT = 0.2
"""Part of the noise's power that its estimate may be wrong by: what is less in the frames is not seen."""


@checked_dataclass
class CoarseToFine:
    """How large frames of closed bodies start."""

    columns: int = 128
    """Binned frames have so many pixels squared, at least (0: all frames start on their own pixels). Coarser ones are
    no cheaper than what follows."""
    chord: Pixels = 6.0
    """Mean chord of the bodies [coarse pixels] below which these do not show their shapes, and finer ones are tried."""
    missing: Share = 0.25
    """Part of the fine structure of the frames, by its power, that surfaces of coarse pixels may leave unexplained."""
    missing_small: Share = 0.03
    """The same of small frames, which begin on their own pixels: there Gaussians show what surfaces of a first volume
    miss (cells left 0.4 to 0.7 %, a foam 10 %)."""
    missing_matter: Share = 0.06
    """Share of all matter, beyond noise, that what is found may leave unexplained before another way is tried. What
    was right left 0.04 to 0.05, and 0.09 or more where the error was a fifth and more (looked at once)."""
    turns: int = 6
    """How often, at most, surfaces that leave more go back to the volume (`turns.in_turns`): a foam took three, 24
    cells in 250 photons a pixel two (looked at once; no script keeps it)."""
    turn_gain: Share = 0.002
    """Part of the residual's square that a turn must take away for another one: turns that left the matter as it was
    took 0.0005 at most, those that helped 0.005 or more (looked at once)."""
    join_missing: bool = True
    """Whether bodies that surfaces of small frames lack are looked for, and join them where they predict unseen frames
    better."""
    coarse_steps: int = 40
    """Steps of the coarse surfaces."""
    finer_steps: int = 40
    """Steps of the surfaces on each finer pixel but the frames' own."""
    last_steps: int = 30
    """Steps on these, which cost most."""
    views: int = 12
    """Frames for which these steps are enough: of fewer, each tells less and costs less, and there are more steps."""
    edge: Pixels = 1.5
    """Mean length of triangles' edges [pixels] from which on they are divided on pixels between."""
    last_edge: Pixels = 2.5
    """The same on the frames' own pixels."""
    fit_steps: int = 10
    """Steps of the fit of Gaussians from there: 40 gain 0.001 of SSIM on held-out frames and lose 0.003 of FRCM (256
    pixels without noise, looked at once; no script keeps it), and take four times as long."""
    fit_rate: Weight = 0.1
    """Adam's rates in these steps, as a share of those of a fit that begins far away: its first ones are as long for
    every parameter, and would blur what is sharp."""

    def __post_init__(self) -> None:
        at_least(self, 0, "columns", "turns")
        at_least(self, 1, "coarse_steps", "finer_steps", "last_steps", "views", "fit_steps")

    def factor(self, shape: tuple[int, int]) -> int:
        """Pixels of frames [H, W] along an edge of the coarsest: a power of two, 1 where these are small."""
        (h, w), factor = shape, 1
        while self.columns and h * w >= (2 * factor * self.columns) ** 2 and min(h, w) >= 2 * factor * FEWEST_ROWS:
            factor *= 2
        return factor

    def of_views(self, count: int) -> CoarseToFine:
        """The same with steps for so many frames: as many looks at them in all as for `views`."""
        more = max(1.0, self.views / max(1, count))
        names = ("coarse_steps", "finer_steps", "last_steps")
        return replace(self, **{name: round(more * getattr(self, name)) for name in names})

    def with_effort(self, effort: float) -> CoarseToFine:
        """The same with `effort` times the steps, at least one."""
        names = ("coarse_steps", "finer_steps", "last_steps", "fit_steps")
        return replace(self, **{name: max(1, round(effort * getattr(self, name))) for name in names})


def in_steps(fit: SurfaceFit, steps: int) -> SurfaceFit:
    """The same fit in so many steps."""
    return replace(fit, schedule=replace(fit.schedule, steps=steps))


Way = Callable[[SurfaceMesh | None], SurfaceMesh | None]
"""How surfaces to begin with are made, beside what has come of the way before; None where there are none."""

First = Callable[[Task], Sequence[Way]]
"""Ways to surfaces to begin with, of the frames of a task. The next one is gone where those before it led to such as
explain these frames badly."""


def coarse_surfaces(
    task: Task, first: First, surfaces: SurfaceOptions, how: CoarseToFine
) -> tuple[SurfaceMesh | None, SurfaceMesh | None]:
    """Surfaces near to those of the frames of `task`, by frames on coarser pixels; None where these do not show them.
    And such as are not near, for they explain the frames badly; None where there are none.

    Small frames (`how.factor`) are their own coarse ones. The matter is one of a known level.
    """
    how, factor, found = how.of_views(len(task.scan.train())), how.factor(task.scan.views.shape), None
    most = how.missing_small if factor == 1 else how.missing
    finest = 1 if factor == 1 else 2
    while factor >= finest and found is None:
        coarse = binned(task, factor)
        found = first_of(coarse, first(coarse), surfaces, how)
        factor //= 2
    if found is None:
        return None, None
    while factor > 1:
        found = _fitted(binned(task, factor), found, surfaces, how)
        factor //= 2
    found = on_pixels(found, task.scan.views.finest, how.last_edge)
    if unexplained(found, task.scan, surfaces) > most:
        near = in_steps(surfaces.fit, how.last_steps)  # edges may be off by more
        found = _run(replace(task, freedom=None), found, near)
        if unexplained(found, task.scan, surfaces) > most:
            return None, found
    return found, None


def last_steps(task: Task, found: SurfaceMesh, surfaces: SurfaceOptions, how: CoarseToFine) -> SurfaceMesh:
    """The surfaces that `coarse_surfaces` has `found`, fitted to the frames of `task` themselves."""
    how = how.of_views(len(task.scan.train()))
    return _run(replace(task, freedom=None), found, in_steps(surfaces.fit, how.last_steps))


def binned(task: Task, factor: int) -> Task:
    """`task` on pixels `factor` times larger; frames are where it says."""
    if factor == 1:
        return replace(task, freedom=None)
    task.on_progress(f"{STAGE}: {factor} × {factor}", 0.0)
    every = torch.arange(len(task.scan))
    light = None if task.lit is None else task.lit.part(every, factor)
    return replace(task, scan=task.scan.binned(factor), lit=light, freedom=None)


def begun_surfaces(task: Task, first: First, surfaces: SurfaceOptions, how: CoarseToFine) -> SurfaceMesh | None:
    """Surfaces on the frames' own pixels after their first steps, of thin bodies, too; None where there are none."""
    how = replace(how.of_views(len(task.scan.train())), chord=0.0)
    own = binned(task, 1)
    return first_of(own, first(own), surfaces, how)


def first_of(task: Task, ways: Sequence[Way], surfaces: SurfaceOptions, how: CoarseToFine) -> SurfaceMesh | None:
    """The first surfaces after some steps on the pixels of `task`, by the first of `ways` that explains the frames, or
    else by the one that does best; None where there are none, or their bodies are too thin for the pixels."""
    tried, found = list[tuple[float, SurfaceMesh]](), None
    for way in ways:
        start = way(found)
        if start is None or mean_chord(start) < how.chord * task.scan.views.finest:
            continue
        found = settled(task, start, surfaces, how)
        if len(ways) == 1:
            return found
        tried.append((missing_matter(found, task, surfaces), found))
        if tried[-1][0] <= how.missing_matter:
            break
    return min(tried, key=lambda one: one[0])[1] if tried else None


def settled(task: Task, start: SurfaceMesh, surfaces: SurfaceOptions, how: CoarseToFine) -> SurfaceMesh:
    """The surfaces `start` after `how.coarse_steps` on the pixels of `task`."""
    return _run(task, start, in_steps(surfaces.fit, how.coarse_steps))


def _fitted(task: Task, found: SurfaceMesh, surfaces: SurfaceOptions, how: CoarseToFine) -> SurfaceMesh:
    """The surfaces on the pixels of `task`."""
    start = on_pixels(found, task.scan.views.finest, how.edge)
    return _run(task, start, in_steps(surfaces.fit, how.finer_steps))


def _run(task: Task, start: SurfaceMesh, options: SurfaceFit) -> SurfaceMesh:
    fit = surface_fit(task.scan, start, options, task.seed, task.uneven)
    return run_quietly(fit, task.report(f"{STAGE}: surfaces"), SurfaceMesh)


def on_pixels(mesh: SurfaceMesh, pixel: float, edge: float) -> SurfaceMesh:
    """The surfaces in units of `pixel` [m], their triangles divided where their edges are longer than `edge` [pixels]
    in the mean."""
    vertices, faces = mesh.vertices.cpu() * (mesh.unit_length / pixel), mesh.faces.cpu()
    while float(edge_lengths(vertices, faces).mean()) > edge:
        vertices, faces = loop_subdivision(vertices, faces)
    finer = len(faces) // len(mesh.faces)
    return SurfaceMesh(vertices, faces, pixel, mesh.matter, mesh.lines, [finer * count for count in mesh.parts])


def mean_chord(mesh: SurfaceMesh) -> float:
    """Mean length [m] of all straight lines through the bodies, 4 V / S (Cauchy 1841)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = torch.linalg.cross(b - a, c - a)
    volume = float((a * normals).sum()) / 6
    return 4 * volume / (0.5 * float(normals.norm(dim=1).sum())) * mesh.unit_length


def unexplained(mesh: SurfaceMesh, scan: Scan, surfaces: SurfaceOptions) -> float:
    """Part of the power of the frames' finest structure that `mesh` leaves unexplained, noise taken off; 0 where noise
    hides all of it. Finest is what two pixels in one do not show."""
    measured = torch.from_numpy(scan.frames).double()
    predicted = frames_of(mesh, scan, surfaces.fit).double()
    noise = 0.75 * float(noise_levels(scan.measured).square().mean())  # one of four orthogonal patterns is left out
    seen, left = (float(_finest(frames).square().mean()) - noise for frames in (measured, measured - predicted))
    return 0.0 if seen <= DOUBT * noise else max(left - DOUBT * noise, 0.0) / seen


def missing_matter(found: SurfaceMesh | GaussianCloud, task: Task, surfaces: SurfaceOptions) -> float:
    """Share of all matter in the frames of `task` that `found` leaves unexplained; 0 where noise may hide all of it
    (`MissingMatter.beyond_noise`)."""
    judge = MissingMatter(task.scan, DeltaBeta(found.matter.delta, found.matter.beta))
    return judge.beyond_noise(frames_of(found, task.scan, surfaces.fit), task.noise)


def _finest(frames: Tensor) -> Tensor:
    """Frames [V, H, W] less their means over 2 × 2 pixels, of one row over two; an odd row and column are left out."""
    h, w = (min(2, n) for n in frames.shape[1:])
    even = frames[:, : frames.shape[1] // h * h, : frames.shape[2] // w * w]
    return even - avg_pool2d(even[None], (h, w))[0].repeat_interleave(h, 1).repeat_interleave(w, 2)
