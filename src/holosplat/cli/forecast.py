"""`holosplat forecast`: the bodies of a run of track, or matter in motion, and their frames at later times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from ..checks import positive, require
from ..io.formats import read_frames, run_reading, run_source
from ..io.reading import Reading, Told, ends_of
from ..motion.cell_model import ChannelFrame
from ..motion.dynamics import DynamicsForecast
from ..motion.fit import MotionFit
from ..motion.flow_forecast import Way
from ..motion.forecast import FORECASTERS, SAME_TIME, Forecaster, PathForecast
from ..motion.learned import GraphForecast
from ..planning.acts import of_forecast
from ..ranges import Many, Positive, Seconds, Seed, Signed, Small, checked_dataclass
from ..scan import Scan
from ..specimens.flow.suspension import PLASMA_VISCOSITY
from ..workflows.evaluate import evaluate
from ..workflows.forecast import (
    FRAMES,
    TABLE,
    Forecasted,
    ForecastOptions,
    config_of,
    require_way,
    write_forecast,
)
from ..workflows.forecast import forecast as carry_on
from ..workflows.preconditions import goes_on
from ..workflows.provenance import environment
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import instants_of, reconstruction_at, where_found
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import COLLECTION, TRACKS
from .places import Output
from .progress import ProgressBar
from .scans import report_run
from .sentence import interruptible, put, say, tell

FLOWING: tuple[Way, ...] = ("rest", "steady", "inertia")
"""Ways of matter that a flow carries."""
OWN = ("auto", "paths", "rigid", "mechanics", "assimilate", "graph", "hybrid", *FLOWING)
"""Ways of --by; other packages add theirs."""
MECHANICAL = ("auto", "mechanics", "hybrid", "assimilate")
OF_CHANNEL = ("flow_axis", "channel_centre", "peak", "shear_modulus", "viscosity", "back")
"""Options of the mechanics, beside the channel."""
TAKEN = {"weights": ("auto", "graph", "hybrid"), "degree": ("paths", "rigid", *MECHANICAL), "channel": MECHANICAL}
"""Options that some ways alone take."""


@checked_dataclass
class ForecastFlags:
    """How bodies move on."""

    times: Many = 10
    """Times ahead."""
    step: Seconds | None = None
    """Between them [s] (default: the median step of the run)."""
    by: str = "auto"
    """Paths go on, each part of the motion as far as frames tell it; rigid: shapes stay; mechanics: red cells in the
    flow of --channel, which their paths over the last times tell; assimilate: the same, fitted to the frames of these
    times (4D-Var); graph: a network that learnt from red cells in flow; hybrid: the mean of mechanics and the network
    by their errors; dmd, sindy: modes of each body's own past; auto: paths, unless the network, or with a channel the
    hybrid, tells the last third of the times better. Matter of reconstruct --motion flow stays by rest; goes on by
    steady, the velocity of each place as at the last time; by inertia, each part with its velocity as far as volumes
    are kept; or by paths, the fitted change of the flow; auto: at rest, unless another tells the last third better."""
    weights: str = ""
    """File of the network's weights, as train --network dynamics writes it (default: those of the package)."""
    degree: int = 2
    """Powers of time that are believed, at most."""
    window: int = 0
    """Last times of the run that tell the motion (0: all)."""
    half_sets: bool = True
    """Whether paths are fitted again to two halves of the times, which say what is believed, and the error."""
    keep_volume: bool = True
    """Whether bodies keep their volume."""
    effort: Positive = 1.0
    """Factor of the numbers of steps of these fits."""

    back: Many = 8
    """Last times over which the flow is fitted, at most a third of the run's."""
    channel: tuple[Small, Small] | None = None
    """Extents [m] of a rectangular channel across the flow, along the other two axes in the order x, y, z."""
    flow_axis: Literal["x", "y", "z"] = "y"
    """Along which axis of the object it leads, either way; a flow along the rotation axis is one along y."""
    channel_centre: tuple[Signed, Signed, Signed] = (0.0, 0.0, 0.0)
    """A point on its axis (x, y, z) [m]."""
    peak: str | None = None
    """Velocity of the undisturbed flow on the axis [m/s], or a range LOW:HIGH (default: by the bodies' velocities)."""
    shear_modulus: str = "2e-6:10e-6"
    """Of the membranes [N/m], or a range LOW:HIGH, within which the run's times tell it."""
    viscosity: Positive = PLASMA_VISCOSITY
    """Of the fluid in and around cells [Pa s]."""

    def options(self) -> ForecastOptions:
        """The options of the forecast; `InputError` for ones that this way does not take."""
        usual, known = ForecastFlags(), (*OWN, *FORECASTERS)
        require(self.by in known, f"--by must be one of {', '.join(known)}, but it is {self.by!r}.")
        for name, ways in TAKEN.items():
            given = getattr(self, name) != getattr(usual, name)
            require(self.by in ways or not given, f"--{name} needs --by {', '.join(ways[:-1])} or {ways[-1]}.")
        for name in OF_CHANNEL:
            given = getattr(self, name) != getattr(usual, name)
            require(self.channel is not None or not given, f"--{name.replace('_', '-')} needs --channel.")
        require(self.half_sets or self.effort == usual.effort, "--effort needs --half-sets.")
        step = 0.0 if self.step is None else positive("--step", self.step, "seconds")
        model = PathForecast(self.degree, self.window, self.by == "rigid", self.keep_volume)
        learned, decides = self._learned(), self.by == "auto"
        flow: Way | None = next((way for way in FLOWING if way == self.by), None)
        return ForecastOptions(
            self.times, step, model, self._dynamics(model), learned, decides, self.half_sets, self.effort, flow
        )

    def _learned(self) -> Forecaster | None:
        if self.by not in OWN:
            return FORECASTERS[self.by](self.window, self.keep_volume)
        if self.by in ("graph", "hybrid", "auto"):
            return GraphForecast(self.weights, self.window, self.keep_volume)
        return None

    def _dynamics(self, paths: PathForecast) -> DynamicsForecast | None:
        require(
            self.by not in ("mechanics", "hybrid", "assimilate") or self.channel is not None,
            f"--by {self.by} needs the channel that cells flow through; say --channel WIDTH HEIGHT [m].",
        )
        if self.channel is None or self.by not in ("auto", "mechanics", "hybrid", "assimilate"):
            return None
        frame = ChannelFrame(self.channel, self.flow_axis, self.channel_centre)
        peak = (0.0, 0.0) if self.peak is None else _number_or_range("peak", self.peak)
        shear = _number_or_range("shear_modulus", self.shear_modulus)
        how = {"back": self.back, "frames": self.by == "assimilate", "paths": paths}
        return DynamicsForecast(frame, peak, shear, self.viscosity, **how)


def _number_or_range(name: str, text: str) -> tuple[float, float]:
    """Both ends of what an option says: LOW:HIGH, or one number above 0 twice. Errors: `InputError` for other text."""
    if ":" in text:
        return ends_of(name, text)
    value = positive(f"--{name.replace('_', '-')}", text)
    return value, value


def forecast(
    run: Positional[Path],
    out: Output,
    how: ForecastFlags = ForecastFlags(),
    seed: Seed = 0,
    resume: bool = False,
    allow_external: bool = False,
) -> None:
    """Carry a run of track, or of reconstruct --motion flow, on: its bodies or its matter, and their frames, at later
    times, with a standard error.

    Frames of the scan after the run's last time (--time-frames) judge the forecast, and are used for nothing else.

    Args:
        run: Run folder of track, or of reconstruct --motion flow.
        out: Run folder to make: what track writes, at the times ahead; forecast.nxs, the predicted frames;
            forecast.csv, the standard error of each body's surface, or of the places of matter; forecast.json.
        seed: Seed of the fits to half-sets.
        resume: Go on with an interrupted forecast; --resume RUN alone, with its run and options.
        allow_external: Follow links of the run's scan to other files; only of files you trust.
    """
    Told(allow_external=allow_external).vouch(run)
    options, folder, new = how.options(), RunFolder(run), RunFolder(out)
    tracked = load_reconstruction(folder)
    times = np.array(instants_of(folder))
    require_way(tracked, times, options)
    own = run_reading(folder.path)  # of all times of the scan, later ones too, where the run found the geometry to be
    reading = replace(own, part=replace(own.part, time_frame=None, time_frames=None))
    scan = where_found(folder, read_frames(folder.source_scan(), reading).in_memory())
    known = scan.exposures[scan.exposures.time <= times[-1]]
    tell("the forecast", of_forecast(known, MotionFit().schedule.views_per_step), out)
    config = config_of(options, scan, folder.read_config(), seed)
    with claimed(new):
        if not goes_on(new, config, resume):
            new.begin(config | environment("cpu"))
        kept = f"interrupted; {out} keeps the last checkpoint, go on with --resume"
        with interruptible(lambda: kept), ProgressBar() as bar:
            found = carry_on(tracked, scan, times, options, seed, journal=new, on_progress=bar.show)
        done = write_forecast(new, tracked, found)
        new.write_source(_source(folder, scan, found, out))
        put(found.lines())
        last = len(found.forecast.times) - 1
        shown = _shown(scan, found)
        final = reconstruction_at(done, found.forecast.times.tolist(), last)
        ahead = f"This is a forecast of the time {1e6 * found.forecast.times[last]:.4g} µs, the last of {last + 1}."
        say(f"report: {report_run(new, final, shown, evaluate(final, shown, None), None, ahead)}")
    written = (COLLECTION, TRACKS, FRAMES, TABLE) if (out / TRACKS).is_file() else (FRAMES, TABLE)
    say("wrote " + ", ".join(str(out / name) for name in written))


def _source(folder: RunFolder, scan: Scan, found: Forecasted, out: Path) -> dict[str, object]:
    """What source.json says: the later times of the run's scan, or else the predicted frames."""
    if not found.judged:
        return run_source(out / FRAMES, Reading())
    later = np.searchsorted(scan.instants, [found.judged[0]["time_s"], found.judged[-1]["time_s"]])
    own = run_reading(folder.path)
    part = replace(own.part, time_frame=None, time_frames=f"{later[0]}:{later[1] + 1}")
    return run_source(folder.source_scan(), replace(own, part=part))


def _shown(scan: Scan, found: Forecasted) -> Scan:
    """What the report shows of the last time: frames that the run did not see, or else those that are predicted."""
    last = found.forecast.times[-1]
    slack = SAME_TIME * (last - found.forecast.object.basis.first)
    held_out = scan[np.flatnonzero(np.abs(scan.exposures.time - last) <= slack)]
    return held_out if len(held_out) else found.predicted[np.flatnonzero(found.predicted.exposures.time == last)]
