"""`reconstruct`: a scan in, a fitted cloud and its run folder out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from ..backends import device_name, resolve
from ..checks import InputError, require
from ..fit.loop import Fit, FitOptions, Record, split_validation
from ..io.gaussians import read_gaussians, write_gaussians
from ..io.json import read_json, write_json
from ..representations import GaussianCloud
from ..scan import Scan
from .provenance import environment, scan_hash
from .run_folder import RunFolder
from .settings import MaterialPrior, Settings
from .start import starting_cloud

CHECKPOINT_SECONDS = 20.0
SMALLEST_FRAME = 11
"""The window of SSIM."""
FLAT_LEVELS = (0.2, 5.0)
"""Between these lies the median of frames that are relative to the flat field."""

RESUMED_WITH = {
    "scan_hash": "scan file",
    "settings": "settings (--preset, --config)",
    "prior": "material (--material, --delta-beta)",
    "seed": "seed (--seed)",
}
"""What must not change between the parts of a run, as messages call it."""

Progress = Callable[[str, float, Record], None]
"""Called with (stage, fraction done of the stage, the last record of the fit or {})."""


@dataclass(frozen=True)
class Reconstruction:
    """A fitted cloud, the energy [keV] of its δ and β, its fit's wave sampling, and how long each stage took [s]."""

    cloud: GaussianCloud
    energy_kev: float
    oversample: int
    timing: dict[str, float]
    finished: bool


def reconstruct(
    scan: Scan,
    prior: MaterialPrior,
    settings: Settings,
    seed: int = 0,
    *,
    folder: RunFolder | None = None,
    resume: bool = False,
    on_progress: Progress = lambda stage, fraction, record: None,
) -> Reconstruction:
    """Fit Gaussians to the training frames of `scan`.

    With a `folder`, everything is written there, and a later call with `resume=True` goes on from the last
    checkpoint, with the same result as if nothing had happened. Ctrl-C (KeyboardInterrupt) ends the fit with
    what it has reached (`finished` is False); during the start there is nothing yet, and it is passed on.
    Errors: `InputError` for scans without training frames or matter, or of several times (`Scan.is_series`), and for
    folders that do not fit.
    """
    require_one_time(scan)
    _check_frames(scan.train())
    if resolve(settings.fit.backend) == "cuda":
        resolve("cpu")  # the start and the judging run there
    train, _ = split_validation(scan.train(), settings.fit.schedule.validation_views)
    checkpoint = _resumed(folder, scan, prior, settings, seed, resume) if folder else None
    timing: dict[str, float] = dict(checkpoint["timing"]) if checkpoint else {}
    if checkpoint:
        cloud = _cloud_of(checkpoint)
    else:
        began = time.perf_counter()
        cloud = starting_cloud(train, prior, settings, seed, lambda stage, part: on_progress(stage, part, {}))
        timing["start"] = time.perf_counter() - began
    fit = Fit(scan, cloud, fit_options(prior, settings, cloud), seed)
    if checkpoint:
        fit.load(checkpoint["fit"])
    elif folder:
        _begin(folder, _config(scan, prior, settings, seed) | environment(fit.backend))
    journal = _Journal(fit, timing, folder, on_progress)
    try:
        fit.run(journal.record)
    except KeyboardInterrupt:
        on_progress("interrupted", 1.0, {})
    return journal.close()


def fit_options(prior: MaterialPrior, settings: Settings, cloud: GaussianCloud) -> FitOptions:
    """Those of the settings; without what bounds the occupancy where nothing says what an occupancy of one is."""
    if prior.kind != "free" or cloud.second is not None:
        return settings.fit
    return replace(settings.fit, objective=replace(settings.fit.objective, overfull=0.0, two_levels=0.0))


def require_one_time(scan: Scan) -> None:
    """`InputError` for a time-resolved scan: one still volume cannot be all of its times."""
    times = scan.instants
    require(
        not scan.is_series,
        f"the scan must show one time, but its frames are of {len(times)}, from {times[0]:g} to {times[-1]:g} s, and "
        f"the reconstruction stands still; choose a time with --time-frame 0 … {len(times) - 1} (Scan.at_instant), or "
        "--time-frame all if nothing moved (Scan.as_static).",
    )


def _check_frames(train: Scan) -> None:
    h, w = train.views.shape
    require(
        min(h, w) >= SMALLEST_FRAME,
        f"frames must have at least {SMALLEST_FRAME} rows and columns, but they have {h} × {w} pixels.",
    )
    level = float(np.median(train.frames))
    require(
        FLAT_LEVELS[0] < level < FLAT_LEVELS[1],
        f"frames must be relative to the flat field (about 1 beside the sample), but their median is {level:.4g}; "
        "add flats (image_key 1) to the scan, or divide by them.",
    )


def load_reconstruction(folder: RunFolder) -> Reconstruction:
    """What a run folder holds; `InputError` if it holds no reconstruction."""
    folder.require_run()
    summary = read_json(folder.summary)
    try:
        timing = {name: float(value) for name, value in summary["timing_s"].items()}
        energy, oversample = float(summary["energy_kev"]), int(summary["oversample"])
        finished = bool(summary["finished"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{folder.summary} must be what reconstruct wrote, but it lacks or garbles {error}."
        ) from error
    plain = summary.get("backend") == "reference"  # then it is judged without compiled kernels, too
    cloud = read_gaussians(folder.gaussians).on("reference" if plain else "cpu")
    return Reconstruction(cloud, energy, oversample, timing, finished)


class _Journal:
    """Keeps the run folder up to date while a fit runs: metrics, checkpoints, and the result at the end."""

    def __init__(self, fit: Fit, timing: dict[str, float], folder: RunFolder | None, on_progress: Progress) -> None:
        self._fit, self._timing, self._folder, self._on_progress = fit, timing, folder, on_progress
        self._pending: list[Record] = []
        self._saved = time.perf_counter()
        if folder is not None:
            folder.start_metrics(fit.columns(), keep_until=fit.step)
            self._save()

    def record(self, record: Record) -> None:
        """Take in one step's record."""
        self._pending.append(record)
        self._on_progress("fit", self._fit.step / self._fit.options.schedule.steps, record)
        up_to_date = record["step"] == self._fit.step  # on a GPU, records come late and in batches
        if up_to_date and time.perf_counter() - self._saved > CHECKPOINT_SECONDS:
            self._save()

    def close(self) -> Reconstruction:
        """Save everything once more, with the result."""
        self._timing["fit"] = self._fit.seconds
        fit = self._fit
        energy, oversample = fit.train.exposures.reference_energy, fit.instrument.oversample
        done = Reconstruction(fit.result(), energy, oversample, dict(self._timing), fit.finished)
        if self._folder is not None:
            self._save()
            write_gaussians(self._folder.gaussians, done.cloud)
            write_json(self._folder.summary, self._summary(done))
        return done

    def _summary(self, done: Reconstruction) -> dict[str, Any]:
        fit, cloud = self._fit, done.cloud
        (h, w), pitch = fit.train.views.shape, fit.train.views.pixel_size
        return {
            "finished": done.finished,
            "backend": fit.backend,
            "device": device_name(fit.backend),
            "steps": fit.step,
            "stopped_early": fit.stopped_early,
            "best_step": fit.best_step if fit.best_step else fit.step,
            "gaussians": len(cloud),
            "oversample": done.oversample,
            "detector": {"rows": h, "columns": w, "pixel_size_m": pitch},
            "energy_kev": fit.train.exposures.reference_energy,
            "material": {"delta": cloud.delta, "beta": cloud.beta, "single": cloud.single_material},
            "second_material": cloud.second and {"delta": cloud.second[0], "beta": cloud.second[1]},
            "timing_s": done.timing,
        }

    def _save(self) -> None:
        if self._folder is None:
            return
        self._folder.append_metrics(self._pending)
        self._pending = []
        cloud = self._fit.cloud
        units = {"unit_length": cloud.unit_length, "delta": cloud.delta, "beta": cloud.beta, "second": cloud.second}
        self._folder.save_checkpoint({"fit": self._fit.state_dict(), "cloud": units, "timing": dict(self._timing)})
        self._saved = time.perf_counter()


def _cloud_of(checkpoint: dict[str, Any]) -> GaussianCloud:
    parameters: list[torch.Tensor] = checkpoint["fit"]["trainable"]["parameters"]
    return GaussianCloud(parameters, **checkpoint["cloud"])


def _resumed(
    folder: RunFolder, scan: Scan, prior: MaterialPrior, settings: Settings, seed: int, resume: bool
) -> dict[str, Any] | None:
    """The checkpoint to go on from, or None for a new run; writes nothing."""
    if not (resume and folder.config.is_file()):
        folder.require_new(advise_resume=not resume)
        return None
    old, same = folder.read_config(), json.loads(json.dumps(_config(scan, prior, settings, seed)))
    for config in (old, same):  # another machine may go on with a run
        for part in ("fit", "volume"):
            config.get("settings", {}).get(part, {}).pop("backend", None)
    for key, name in RESUMED_WITH.items():
        require(
            old.get(key) == same[key],
            f"--resume needs the {name} that {folder.path} was started with; use the same, or another --out.",
        )
    return folder.load_checkpoint()


def _begin(folder: RunFolder, config: dict[str, Any]) -> None:
    """Make the folder, once there is something to put in it."""
    folder.create()
    write_json(folder.config, config)


def _config(scan: Scan, prior: MaterialPrior, settings: Settings, seed: int) -> dict[str, Any]:
    return {"settings": asdict(settings), "prior": prior.as_dict(), "seed": seed, "scan_hash": scan_hash(scan)}
