"""`forecast`: a run of `track`, or of matter in motion, in; it and its holograms at later times out, with a band."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch

from ..checks import InputError, as_written, positive, require
from ..fit.run import Journal, Run
from ..inference import Decision
from ..io.atomic import write_json, write_rows
from ..io.nxtomo import write_scan
from ..io.objects import write_object
from ..methods.presets import SCHEMA
from ..metrics import image_scores, intensity_range
from ..motion.assimilate import carry_by_frames
from ..motion.dynamics import DynamicsForecast, HybridForecast, window_of
from ..motion.flow_forecast import PATHS, FlowForecast, FlowHistory, Way, forecast_matter, require_goes_on
from ..motion.forecast import SAME_TIME, Forecast, Forecaster, Halves, History, PathForecast, decided
from ..motion.learned import GraphForecast, read_dynamics
from ..motion.measures import early_part, half_fit, half_sets
from ..optics.background import Light
from ..progress import FitProgress
from ..ranges import Positive, Seconds, Within, checked_dataclass
from ..representations import GaussianCloud, MovingGaussians, MovingSurfaces
from ..scan import Scan
from ..tables import read_rows, to_table
from .evaluate import render_object
from .provenance import RUN, scan_hash
from .reconstruct import load_reconstruction
from .reconstruction import Reconstruction, summary_of, write_rest
from .run_folder import RunFolder
from .run_illumination import light_of
from .track import write_tracks

FRAMES, TABLE, NUMBERS = "forecast.nxs", "forecast.csv", "forecast.json"
MOST_TIMES = 1000
"""Of a forecast."""
UNTOLD = 0.5
"""Standard error after the fit over that before from which on a number counts as undetermined."""


@checked_dataclass
class ForecastOptions:
    """Options of a forecast."""

    kind: ClassVar[str] = "forecast"

    times: Annotated[int, Within(1, MOST_TIMES)] = 10
    """Times ahead."""
    step: Seconds = 0.0
    """Between them [s] (0: the median step of the run)."""
    model: PathForecast = field(default_factory=PathForecast)
    """How paths go on."""
    dynamics: DynamicsForecast | None = None
    """How cells go on by mechanics (default: all bodies go on their paths)."""
    learned: Forecaster | None = None
    """How bodies go on by what was learnt; with `dynamics`, by the mean of both."""
    decides: bool = False
    """Whether paths, what was learnt and the mean compete, by the last third of the run's times."""
    half_sets: bool = True
    """Whether paths are fitted again to two halves of the times, which say what is believed of the motion."""
    effort: Positive = 1.0
    """Factor of the numbers of steps of these fits."""
    flow: Way | None = None
    """How matter in motion goes on (default: the way that tells the last third of the times best)."""

    @property
    def way(self) -> Forecaster:
        """How bodies go on, if it is not decided otherwise."""
        if self.dynamics and self.learned:
            return HybridForecast((self.learned, self.dynamics))
        return self.dynamics or self.learned or self.model

    def ahead(self, tracked: np.ndarray) -> np.ndarray:
        """Times [N] s of the forecast after those of the run, `tracked` [T] s."""
        step = self.step or float(np.median(np.diff(tracked)))
        return tracked[-1] + positive("step", step, "seconds") * np.arange(1, self.times + 1)


@dataclass(frozen=True)
class Forecasted:
    """What `forecast` found. forecast: bodies, or matter, and band; predicted: the frames at its times; judged: scores
    against the frames that the run did not see, a row a time, empty without such frames; decision: between ways."""

    forecast: Forecast | FlowForecast
    predicted: Scan
    judged: list[dict[str, float]]
    decision: Decision | None = None

    def lines(self) -> list[str]:
        """The numbers as a few lines of text."""
        step, last = self.forecast.times[0], self.forecast.times[-1]
        band, of = 1e6 * self.forecast.usual_band(), "surfaces" if isinstance(self.forecast, Forecast) else "places"
        said = [
            f"standard error of {of}: not told, for that needs half-sets, for which the run has too few times, or "
            "which --no-half-sets leaves out"
        ]
        if np.isfinite(band).all():
            said = [f"standard error of {of}: {band[0]:.3f} µm at {step:.4g} s, {band[-1]:.3f} µm at {last:.4g} s"]
        if self.decision is not None:
            said.append(self.decision.line)
        if isinstance(self.forecast, Forecast) and self.forecast.told:
            said.append(flow_in_words(self.forecast.told))
        if self.judged:
            ends = [self.judged[0], self.judged[-1]]
            words = (f"SSIM {one['ssim']:.4f} (without change {one['ssim_still']:.4f})" for one in ends)
            times = (f"{one['time_s']:.4g} s" for one in ends)
            said.append("held-out frames: " + ", ".join(f"{w} at {t}" for w, t in zip(words, times)))
        return said


def tracked_bodies(run: Reconstruction) -> MovingSurfaces:
    """The bodies of a run of `track`; `InputError` for any other run."""
    if not isinstance(run.object, MovingSurfaces):
        raise InputError(
            f"a forecast needs a run of track, with bodies in motion, but this one holds {run.object.described}; run "
            "holosplat track on a scan of several times."
        )
    return run.object


def require_way(run: Reconstruction, times: np.ndarray, options: ForecastOptions) -> None:
    """`InputError`, before any fit, for a way that the run's object does not go in, where mechanics have no cell to
    carry on after the tracked `times` [T] s, and where what was learnt cannot be asked, or is no network;
    `MissingError` without its library."""
    if isinstance(run.object, MovingGaussians):
        learned = options.learned is None or (options.decides and options.learned == GraphForecast())
        require(
            learned and options.dynamics is None and (options.model, options.effort) == (PathForecast(), 1.0),
            "--by must be auto, rest, steady, inertia or paths for matter in motion, but it, or an option beside it, "
            "is of bodies; leave it.",
        )
        require_goes_on(run.object, options.flow)
        return
    tracked_bodies(run)
    require(
        options.flow is None,
        f"--by {options.flow} is of matter in motion, but this run holds bodies; take --by auto or paths.",
    )
    if isinstance(options.learned, GraphForecast) and options.learned.weights:
        read_dynamics(Path(options.learned.weights))
    if options.dynamics is not None:
        window_of(History(tracked_bodies(run), times), options.ahead(times), options.dynamics)
    if options.learned is not None and not options.decides:
        options.learned.fit(History(tracked_bodies(run), times)).ahead(options.ahead(times))


def forecast(
    run: Reconstruction,
    scan: Scan,
    times: np.ndarray,
    options: ForecastOptions = ForecastOptions(),
    seed: int = 0,
    *,
    journal: Journal | None = None,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Forecasted:
    """What the bodies, or the matter in motion, of `run` at `times` [T] s and their holograms are expected to be
    afterwards.

    scan: of the run, and of later times where it has them: these judge the forecast, and are used for nothing else;
    journal: keeps the fits to bodies. Errors: `InputError` for runs of neither, and for a scan without the run's last
    time.
    """
    times = np.asarray(times, dtype=np.float64)
    ahead = options.ahead(times)
    slack = SAME_TIME * float(np.median(np.diff(times)))
    within = (scan.exposures.time >= times[0] - slack) & (scan.exposures.time <= times[-1] + slack)
    known = scan[np.flatnonzero(within)]
    last = np.flatnonzero(np.abs(scan.exposures.time - times[-1]) <= slack)
    require(len(last) > 0, f"the scan must have frames of the run's last time, {times[-1]:.6g} s, but it has none.")
    if isinstance(run.object, MovingGaussians):
        moving = FlowHistory(run.object, _evened(run, known)[0], partial(_rendered, run))
        way = options.flow or (None if options.decides else PATHS)
        found, decision, kind = forecast_matter(
            moving, ahead, way, options.half_sets, lambda stage, part: on_progress(stage, part, {})
        )
    else:
        found, decision, kind = _of_bodies(run, known, times, ahead, options, seed, journal, on_progress)
    exposures, backend = scan.exposures[last].repeated(ahead), found.object.backend
    frames = render_object(found.object, exposures, run.oversample, backend)
    predicted = Scan(frames, exposures, np.zeros(len(frames), dtype=bool), {"forecast": kind})
    return Forecasted(found, predicted, _judged(found, run, scan, known, slack), decision)


def _rendered(run: Reconstruction, matter: GaussianCloud, scan: Scan) -> torch.Tensor:
    """The frames [V, H, W] of `matter` as `scan` takes them."""
    return torch.from_numpy(render_object(matter, scan.exposures, run.oversample, matter.backend))


def _of_bodies(
    run: Reconstruction,
    known: Scan,
    times: np.ndarray,
    ahead: np.ndarray,
    options: ForecastOptions,
    seed: int,
    journal: Journal | None,
    on_progress: FitProgress,
) -> tuple[Forecast, Decision | None, str]:
    """The forecast of bodies, what was decided, and the way in which they go on."""
    tracked_bodies(run)
    history = _history(run, known, times, options, seed, Run(journal), on_progress)
    on_progress("forecast", 0.0, {})
    decision, way = None, options.way
    if options.dynamics is not None and options.dynamics.frames:
        window = window_of(history, ahead, options.dynamics)
        found = carry_by_frames(window, _evened(run, known)[0], run.oversample)
    else:
        if options.decides:
            others, left_out = _others(options, history, ahead)
            decision = decided(history, options.model, others)
            decision = replace(decision, by=decision.by + left_out)
            way = {one.kind: one for one in (options.model, *others)}[decision.choice]
        found = way.fit(history).ahead(ahead)
    if history.halves is None:
        found = replace(found, band=np.full_like(found.band, np.nan))
    return replace(found, rest=run.rest), decision, way.kind


def _others(options: ForecastOptions, history: History, ahead: np.ndarray) -> tuple[list[Forecaster], str]:
    """What competes with paths, from simple to complex; and why the network does not, where it cannot look so far."""
    if history.early is None:
        return [], "; nothing else was asked, for that needs half-sets"
    mechanics: list[Forecaster] = [options.dynamics] if options.dynamics else []
    if options.learned is None:
        return mechanics, ""
    try:
        options.learned.fit(history).ahead(ahead)
    except InputError as error:
        return mechanics, f"; {options.learned.kind} was not asked: {error}"
    return [options.learned, *([options.way] if mechanics else [])], ""


def flow_in_words(flow: dict[str, float]) -> str:
    """The estimated flow, and what the window does not determine, in words."""
    said = f"flow: peak {flow['peak_m_s']:.4g} m/s, shear modulus {1e6 * flow['shear_n_m']:.3g} µN/m"
    for name, word in (("peak", "the peak"), ("shear", "the shear modulus")):
        told = flow.get(f"{name}_told", np.nan)
        if np.isnan(told):
            said += "" if "unasked" in flow else f"; {word} was given"
        elif told > UNTOLD:
            said += f"; the window does not tell {word} (standard error {told:.2f} of the range's)"
        else:
            said += f"; {word} to {told:.2f} of the range's standard deviation"
    if "unasked" in flow:
        said += f"; how well the window tells them is not asked where {flow['unasked']:.0f} numbers are unknown"
    return said + "; of the membrane's viscosity it says nothing"


def write_forecast(folder: RunFolder, run: Reconstruction, found: Forecasted) -> Reconstruction:
    """The run folder of a forecast: bodies.pvd, tracks.csv and object.h5 as track writes them, at the times ahead;
    forecast.nxs, the predicted frames; forecast.csv, the band of each body; forecast.json, all numbers.

    The run has begun with `config_of`. Returns the bodies as a reconstruction.
    """
    said = found.forecast
    done = replace(run, object=said.object, method=ForecastOptions.kind, timing={}, verdict=None, total=None)
    write_object(folder.object, said.object, folder.marks())
    of_bodies = isinstance(said, Forecast)
    if of_bodies and said.rest is not None:
        mesh = said.rest.elastic.membrane.mesh
        write_rest(folder, replace(mesh, vertices=said.bodies.unit_length * mesh.vertices))
    told = {"steps": 0, "times_s": said.times.tolist(), **({"bodies": said.bodies.count} if of_bodies else {})}
    folder.write_summary(summary_of(done, None, found.predicted) | told)
    write_scan(folder.path / FRAMES, found.predicted)
    errors = ([f"{t:.15g}", k, f"{e:.4g}"] for t, band in zip(said.times, said.band) for k, e in enumerate(band))
    write_rows(folder.path / TABLE, ["time_s", "body" if of_bodies else "part", "standard_error_m"], errors)
    band = [None if np.isnan(one) else float(one) for one in said.usual_band()]
    write_json(
        folder.path / NUMBERS,
        {
            "times_s": said.times.tolist(),
            "band_m": band,
            "held_out": found.judged,
            "of": "bodies" if of_bodies else "matter",
            "flow": said.told if of_bodies else {},
            "decision": found.decision and found.decision.as_dict(),
        },
    )
    if of_bodies:
        write_tracks(folder, said.bodies, found.predicted)
    return done


def read_band(folder: RunFolder) -> tuple[np.ndarray, np.ndarray]:
    """Times [N] s and standard errors [N, B] m, NaN where nothing tells them, of the forecast in `folder`."""
    path = folder.path / TABLE
    with as_written(path, "what forecast wrote"):
        rows = read_rows(path, "what forecast wrote")
        times = np.array(list(dict.fromkeys(float(row["time_s"]) for row in rows)))
        band = np.array([float(row["standard_error_m"]) for row in rows]).reshape(len(times), -1)
    return times, band


def read_forecast(folder: RunFolder) -> Forecast:
    """The forecast in `folder`, without the numbers found on the way. Errors: `InputError` for another run."""
    require(
        (folder.path / TABLE).is_file(),
        f"a forecast must be a folder that holosplat forecast wrote, but {folder.path} holds no {TABLE}; forecast a "
        "run of track first.",
    )
    run = load_reconstruction(folder)
    return Forecast(tracked_bodies(run), *read_band(folder), rest=run.rest)


def config_of(options: ForecastOptions, scan: Scan, run: dict[str, Any], seed: int) -> dict[str, Any]:
    """Entries of config.json. run: that of the run whose future is predicted."""
    return {
        "schema_version": SCHEMA,
        "method": {
            **{
                "kind": options.kind,
                "of": run.get(RUN, ""),
                "body": run["method"].get("body"),
                "forecast": "auto" if options.decides else options.flow or options.way.kind,
            },
            **to_table(options),
        },
        "seed": seed,
        "prior": run["prior"],
        "light": run.get("light", {}),
        "matter": run.get("matter", "levels"),
        "scan_hash": scan_hash(scan),
    }


def _history(
    run: Reconstruction,
    known: Scan,
    times: np.ndarray,
    options: ForecastOptions,
    seed: int,
    kept: Run,
    on_progress: FitProgress,
) -> History:
    """The run's bodies, with fits to halves of the training frames of all times and of the first two thirds of them;
    without these for too few times, and where they are not asked for."""
    bodies, (train, part) = tracked_bodies(run), _evened(run, known)
    if not options.half_sets or len(train.instants) < 2 * bodies.basis.count:
        return History(bodies, times)
    fit, before = half_fit(run.rest), [0.0, 0.0]
    fit = replace(fit, schedule=fit.schedule.with_effort(options.effort))

    def show(record: dict[str, float]) -> None:
        before[0], before[1] = before[0] + (record["step"] < before[1]), record["step"]
        on_progress("half-sets", 0.25 * (before[0] + record["step"] / fit.schedule.steps), record)

    def halves(scan: Scan, start: MovingSurfaces, light: Light | None, own: Run) -> Halves:
        return half_sets(scan, start, fit, seed, light, rest=run.rest, run=own, on_record=show)

    whole = halves(train, bodies, part, kept)
    early, start = early_part(train, bodies, times)
    light = part and part.part(torch.from_numpy(early))
    return History(bodies, times, whole, halves(train[early], start, light, kept.part("early")))


def _evened(run: Reconstruction, known: Scan) -> tuple[Scan, Light | None]:
    """The training frames over the light that the run found, and that light, where it is uneven."""
    kept = np.flatnonzero(~known.is_test)
    train, lit = known[kept], light_of(known, run.light, run.still)
    if lit is None:
        return train, None
    part = lit.part(torch.from_numpy(kept))
    return replace(train, frames=part.evened(torch.from_numpy(train.frames)).numpy()), part


def _judged(
    found: Forecast | FlowForecast, run: Reconstruction, scan: Scan, known: Scan, slack: float
) -> list[dict[str, float]]:
    """Scores of the frames after the run's last time and within the forecast, a row a time; `_still`: of bodies that
    stay where they are at the last time."""
    last, rows = float(found.object.basis.first), list[dict[str, float]]()
    data_range = intensity_range(known.frames)
    lit = light_of(scan, run.light, run.still)
    for time in scan.instants[(scan.instants > last + slack) & (scan.instants <= found.times[-1] + slack)]:
        kept = np.flatnonzero(scan.exposures.time == time)
        measured = scan[kept].frames
        factor = 1.0 if lit is None else lit.part(torch.from_numpy(kept)).factor().numpy().astype(np.float32)
        row = {"time_s": float(time)}
        for ending, obj in (("", found.object.at(float(time))), ("_still", found.object.at(last))):
            said = render_object(obj, scan.exposures[kept], run.oversample, found.object.backend) * factor
            mean = image_scores(said, measured, data_range).mean
            row |= {f"{name}{ending}": float(mean[name]) for name in ("ssim", "psnr", "l1")}
        rows.append(row)
    return rows
