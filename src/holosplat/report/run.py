"""The report of a run folder: collects the content of the page, with the view in three dimensions."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..checks import as_written
from ..frames import evenly
from ..geometry import Grid, Views
from ..io.atomic import read_json
from ..io.volumes import read_guess
from ..methods import METHODS, learned
from ..metrics import volume_scores
from ..motion.measures import measured_columns
from ..optics.background import Light
from ..optics.sampling import views_seeing
from ..projectors.voxels import voxel_line_integrals
from ..representations import MovingSurfaces, Stored
from ..scan import Scan
from ..tables import to_table
from ..units import beam_named, number_of, span, wavenumber
from ..volume import Volume
from ..workflows.evaluate import TIMES, Evaluation, lines_of_times, of_absorption, render
from ..workflows.forecast import NUMBERS, flow_in_words, read_band
from ..workflows.motion_choice import begun_motion
from ..workflows.reconstruction import Reconstruction, instants_of
from ..workflows.rehearsal import read_rehearsal
from ..workflows.run_folder import RunFolder
from ..workflows.track import read_errors
from .content import GuessShown, HeldOutViews, LitViews, Moving, ProjectedMaps, ReportContent, view_labels
from .page import write_report
from .style import DELTA_MAP, ENDS, around_zero, data_uri, new_figure, styled
from .surface import ForecastShown
from .view3d.view import SLICE_BYTES, VOLUME_BYTES, View3D, part_of, raster_of, volume_part

MOST_FRAMES = 24
"""Times that the animation of a report shows, at most."""
MOST_LIT = 3
"""Training frames whose light a report draws."""
LARGEST_VOLUME = 160
"""Voxels along an edge of the volume that a report draws where no truth fixes its grid."""


def report_run(
    folder: RunFolder,
    reconstruction: Reconstruction,
    scan: Scan,
    evaluation: Evaluation,
    truth: Volume | None,
    remark: str = "",
) -> Path:
    """Write `report.html` of a run, of bodies in motion with the volume at the time in the middle; returns its path.

    remark: a sentence on what `scan` is a part of, which follows the summary of it.
    """
    config, moving, chosen = folder.read_config(), None, begun_motion(folder.path)
    times = "; ".join(line.strip().rstrip(".") for line in lines_of_times(folder.path / TIMES))
    remark = " ".join(filter(None, (remark, times and f"Times: {times}.")))
    turned = found = reconstruction.object
    if isinstance(found, MovingSurfaces):
        moving = moving_of(reconstruction, scan, evaluation.light, read_errors(folder))
        found = found.at(_middle(moving))
    views = scan.views
    grid = truth.grid if truth is not None else Grid.of_views(views, min(1.0, LARGEST_VOLUME / max(views.shape)))
    held_out, labels = None, np.array(view_labels(scan.views))
    if evaluation.test is not None and evaluation.predicted is not None:
        test = scan.test()
        held_out = HeldOutViews(
            test.frames,
            evaluation.predicted,
            _timed(labels[scan.is_test], test),
            evaluation.test,
            test.views.pixel_sizes,
            evaluation.verdict,
        )
    volume, scores = found.voxelise(grid), evaluation.volume
    material = found.matter.single and reconstruction.choice.matter == "levels"  # else a unit of δ
    train = scan.train()
    absorbs = not scan.exposures.distance.any()  # then δ, where it is told, is β times a ratio that no frame shows
    delta_told = reconstruction.delta_told and not absorbs
    if not delta_told:
        volume = of_absorption(volume)
        truth = None if truth is None else of_absorption(truth)
    if absorbs and reconstruction.delta_told:
        scores = None if truth is None else volume_scores(volume, truth)
        remark = f"{remark} {IN_CONTACT}"
    with as_written(folder.config, "of a run that has begun"):
        own = config.get("method", config.get("settings", {}))
        said: dict[str, Any] = {
            "title": _title(config, reconstruction),
            "settings": {"seed": config["seed"], "prior": config["prior"], **own},
            "usual": to_table(METHODS[own["kind"]]) if own.get("kind") in METHODS else {},
            "versions": dict(config["versions"]),
            "machine": dict(config["machine"]),
            "input_hash": str(config["scan_hash"]),
        }
    content = ReportContent(
        summary=" ".join(filter(None, (_summary(reconstruction, scan, moving), remark))),
        reconstruction=volume,
        truth=truth,
        energy_kev=scan.exposures.reference_energy,
        pixel_size=scan.views.finest,
        held_out=held_out,
        projections=_projections(found, scan.views, truth),
        volume_scores=scores,
        seen=views_seeing(train.exposures, grid) == len(train),
        material_delta=(found.matter.beta if absorbs else found.matter.delta) if material else None,
        explained=reconstruction.verdict,
        delta_told=delta_told,
        total=reconstruction.total,
        rehearsal=read_rehearsal(folder),
        at_rest=not instants_of(folder),
        geometry=reconstruction.geometry,
        lit=_lit(reconstruction, scan, evaluation),
        moving=moving,
        guess=_guess(folder, reconstruction),
        forecast=_forecast(folder),
        decisions=(*([chosen] if chosen else ()), *reconstruction.choice.decisions),
        view=view_of(turned, volume, truth, scan, delta_told),
        history=folder.history(),
        seconds=sum(reconstruction.timing.values()),
        timing={stage: f"{seconds:.1f} s" for stage, seconds in reconstruction.timing.items()},
        run=folder.name(),
        scan=_scan_of(folder),
        **said,
    )
    return write_report(content, folder.report)


IN_CONTACT = "Frames in contact show absorption, as µ = 4πβ/λ; δ is β times the ratio that was told."
NAMES = {
    "gaussians": "Gaussian reconstruction",
    "surfaces": "Reconstruction as closed surfaces",
    "moving-surfaces": "Reconstruction as closed surfaces in motion",
    "moving-gaussians": "Reconstruction as Gaussians that a flow carries",
    "space-time-field": "Reconstruction as a field of space and time",
    "voxels": "Voxel reconstruction",
}
"""What a report is called, by the kind of object; others are called by what they say they are."""

COUNTED = {1: "one", 2: "two", 3: "three", 4: "four"}


def _guess(folder: RunFolder, reconstruction: Reconstruction) -> GuessShown | None:
    """What a network guessed, beside what was found; None where none was asked."""
    if not folder.guess.is_file():
        return None
    volume, spread, of_copies = read_guess(folder.guess)
    delta = float(np.abs(volume.delta).max()) or 1.0
    unit = reconstruction.object.matter.delta if reconstruction.object.matter.single else delta
    found = reconstruction.object.voxelise(volume.grid).delta / unit
    said = [each.line for each in reconstruction.choice.decisions if each.name == learned.NAME]
    why = ". ".join(said) or reconstruction.choice.begun
    return GuessShown(volume.delta / unit, found, spread, volume.grid, why, of_copies)


def _forecast(folder: RunFolder) -> ForecastShown | None:
    """The errors and scores of a forecast; None of another run."""
    if not (folder.path / NUMBERS).is_file():
        return None
    times, band = read_band(folder)
    said = read_json(folder.path / NUMBERS)
    flow = flow_in_words(said["flow"]) if said.get("flow") else ""
    return ForecastShown(times, band, said["held_out"], flow, said.get("of", "bodies") == "bodies")


def _scan_of(folder: RunFolder) -> str:
    """The scan of a run as a command takes it."""
    told = str(read_json(folder.source).get("scan") or "") if folder.source.is_file() else ""
    return shlex.quote(told) if told else "SCAN"


def _title(config: Mapping[str, Any], reconstruction: Reconstruction) -> str:
    found = reconstruction.object
    matter, name = found.matter, NAMES.get(found.kind, f"Reconstruction as {found.described}")
    told = max(len(matter), 1 + len(config["prior"].get("others", ())))  # a volume has one channel for all that is told
    count = "δ and β free" if not matter.occupancies else f"{COUNTED.get(told, told)} material{'s' * (told > 1)}"
    if not reconstruction.delta_told:
        return f"{name}, of absorption alone"
    said = {"known": ", known", "ratio": " of known δ/β", "free": ", found" if matter.occupancies else ""}
    return f"{name}, {count}{said[config['prior']['kind']]}"


def _summary(reconstruction: Reconstruction, scan: Scan, moving: Moving | None) -> str:
    exposures, views = scan.exposures, scan.views
    h, w = views.shape
    distance = f"{span(100 * exposures.distance)} cm behind the sample" if exposures.distance.any() else "in contact"
    if views.sources is not None:
        distance += f", in cones of a source {span(1e3 * views.sources)} mm before it"
    state = "" if reconstruction.finished else " The fit was interrupted before its end."
    if moving is not None:
        state += f" Volumes, slices and projections are those at {1e6 * _middle(moving):.4g} µs."
    return (
        f"{len(scan.train())} training and {number_of(len(scan.test()), 'held-out frame')} of {h} × {w} pixels of "
        f"{span(1e6 * views.pixel_sizes)} µm, {beam_named(exposures.energy_kev)[1]}, {distance}; "
        f"{reconstruction.object.described}.{state}"
    )


def _middle(moving: Moving) -> float:
    return float(moving.times[len(moving.times) // 2])


def _timed(labels: np.ndarray, test: Scan) -> tuple[str, ...]:
    """The labels of views, with the time where there are several."""
    times = test.exposures.time
    if len(np.unique(times)) < 2:
        return tuple(labels)
    return tuple(f"{label}, {1e6 * time:.4g} µs" for label, time in zip(labels, times))


def _lit(reconstruction: Reconstruction, scan: Scan, evaluation: Evaluation) -> LitViews | None:
    """A few training frames with the light that they have beside the prediction; None where light is even."""
    light = evaluation.light
    if light is None or scan.is_test.all():
        return None
    train = np.flatnonzero(~scan.is_test)
    chosen = train[evenly(len(train), MOST_LIT)]
    shown = scan[chosen]
    predicted = render(reconstruction, shown.exposures)
    measured, part = shown.measured, light.part(torch.from_numpy(chosen))
    if part.background is not None:
        fixed = 1.0 if part.still is None else part.still
        part = replace(part, background=part.background.seen_beside(measured / fixed, torch.from_numpy(predicted)))
    return LitViews(
        shown.frames,
        part.factor().numpy(),
        predicted,
        tuple(np.array(view_labels(scan.views))[chosen]),
        light.in_words,
        shown.views.pixel_sizes,
    )


def _projections(found: Stored, views: Views, truth: Volume | None) -> ProjectedMaps:
    """B and D of the first view and the one most at right angles to it, through the truth's voxels where known."""
    first, other = 0, int(abs(views.rotations[:, 2] @ views.rotations[0, 2]).argmin())
    indices = [first, other] if other != first else [first]
    chosen, labels = views[indices], tuple(np.array(view_labels(views))[indices])
    with torch.no_grad():
        beta, delta = (line.numpy() for line in found.project(chosen))
        if truth is None:
            return ProjectedMaps(beta, delta, labels, pixels=chosen.pixel_sizes)
        values = torch.stack([torch.from_numpy(truth.beta), torch.from_numpy(truth.delta)])
        lines = voxel_line_integrals(values, truth.grid, chosen, step=0.5)
        true_beta, true_delta = (line.numpy() for line in lines.unbind(1))
    return ProjectedMaps(beta, delta, labels, true_beta, true_delta, chosen.pixel_sizes)


def moving_of(
    done: Reconstruction, scan: Scan, light: Light | None, errors: Mapping[str, np.ndarray] | None = None
) -> Moving:
    """What is shown of a run in motion and its `scan`; light: of all its frames, None where it is even."""
    assert isinstance(done.object, MovingSurfaces)
    when, order = scan.exposures.time, np.argsort(scan.is_test, kind="stable")  # frames for training first
    times = np.unique(when)
    shown = evenly(len(times), MOST_FRAMES)
    chosen = np.array([order[np.flatnonzero(when[order] == times[t])[0]] for t in shown])
    predicted = render(done, scan.exposures[chosen])
    if light is not None:
        predicted = predicted * light.factor().numpy()[chosen]
    tracks = measured_columns(done.object, scan.exposures)
    grid = Grid.of_views(scan.views)
    middle, half = grid.centre, 0.5 * np.array(grid.shape[::-1]) * np.array(grid.voxel_size)
    box = (middle - half, middle + half)
    shots = (shown, scan.views[chosen], scan.frames[chosen], predicted)
    return Moving(done.object, times, tracks, *box, *shots, errors=errors or {})


def view_of(obj: Stored, volume: Volume, truth: Volume | None, scan: Scan, delta_told: bool = True) -> View3D:
    """What can be turned of `obj`, whose `volume` (and `truth`, where known) also gives the slices.

    volume, truth: of the middle time where something moves.
    """
    exposures = scan.exposures[np.array([0])]
    _, _, pixel = raster_of(*exposures.views.shape, exposures.views.pitch)
    times = np.unique(scan.exposures.time) if isinstance(obj, MovingSurfaces) else None
    shift = first_phase(obj, scan, delta_told)
    sign = obj.matter.channels[0].sign
    shown = {"reconstruction": volume} | ({} if truth is None else {"truth": truth})
    parts = {"reconstruction": part_of(obj, volume, pixel, times)}
    if truth is not None and times is None:
        parts["truth"] = volume_part(truth, pixel, VOLUME_BYTES)
    low, high = np.percentile(scan.train().frames if len(scan.train()) else scan.frames, ENDS)
    return View3D(
        parts=parts,
        slices={name: volume_part(v, pixel, SLICE_BYTES) for name, v in shown.items()},
        exposures=exposures,
        views=scan.views,
        labels=view_labels(scan.views),
        grey=(float(low), float(max(high, low + 1e-6))),
        ends=phase_ends(shift, sign),
        picture=still_picture(shift, sign),
        delta_told=delta_told,
    )


def first_phase(obj: Stored, scan: Scan, delta_told: bool) -> np.ndarray:
    """k∫δ [H, W] [rad] in the first view; where δ is not known the absorption 2k∫β."""
    exposures = scan.exposures[np.array([0])]
    with torch.no_grad():
        beta, delta = obj.project(exposures.views)
    return float(wavenumber(exposures.energy_kev)[0]) * (delta if delta_told else 2 * beta)[0].numpy()


def phase_ends(phase: np.ndarray, sign: float = 1.0) -> tuple[float, float]:
    """Values between which a phase is shown; sign: that of the matter's δ. They have 0 between them or at an end."""
    low, high = (float(value) for value in np.percentile(sign * phase, (100 - ENDS[1], ENDS[1])))
    return sign * min(low, 0.0), sign * (max(high, 0.0) or 1.0)


@styled
def still_picture(phase: np.ndarray, sign: float = 1.0) -> str:
    """The picture that stands where the view cannot be turned, as a `data:` URI; sign: that of the matter's δ."""
    rows, columns = phase.shape
    figure = new_figure(2.4, 2.4 * rows / columns, layout="none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    colours, (low, high) = around_zero(DELTA_MAP, (min(ends := phase_ends(phase, sign)), max(ends)))
    axes.imshow(phase, cmap=colours, vmin=low, vmax=high)
    axes.axis("off")
    return data_uri(figure, "png")
