"""The thesis' study, rerun: its configurations, its schedule and loss, and curves of every score over steps."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from holosplat.backends import resolve
from holosplat.fit.loop import DivergedError, Fit
from holosplat.geometry import Grid, Views
from holosplat.materials import WATER
from holosplat.matter import Matter
from holosplat.methods.gaussians import gaussian_plan
from holosplat.progress import FitProgress
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Scan
from holosplat.version import source_commit
from holosplat.workflows.provenance import environment, scan_hash

from . import looks
from .cloud import DenseCloud
from .configurations import THESIS_TABLE, Configuration, Pace, Recipe
from .folder import CURVES, StudyFolder
from .measured import Measured, mean_inside

START_DENSITY = 0.01
"""Mean density of the random start, in units of water: about what 16 cells fill of their channel."""
SAVE_EVERY_S = 60.0
"""Seconds between checkpoints of a configuration."""


def run_study(
    measured: Measured,
    chosen: Sequence[Configuration],
    pace: Pace,
    seed: int,
    folder: StudyFolder,
    on_progress: FitProgress = lambda name, fraction, record: None,
) -> None:
    """Run what is not finished yet of the `chosen` configurations, one after the other.

    Ctrl-C (KeyboardInterrupt) is passed on; the next call goes on from the last checkpoint, with the same result.
    """
    folder.begin(about(measured, pace, seed))
    for configuration in chosen:
        if not folder.finished(configuration.name):
            run_configuration(measured, configuration, pace, seed, folder, on_progress)


def about(measured: Measured, pace: Pace, seed: int) -> dict[str, Any]:
    """What study.json says."""
    return {
        "case": measured.case,
        "physics": measured.physics,
        "pace": asdict(pace),
        "warmup_steps": pace.recipe(THESIS_TABLE[0], 1, 1.0).fit.schedule.warmup_steps,
        "seed": seed,
        "scan_hash": scan_hash(measured.scan),
        "frames": list(measured.scan.frames.shape),
        "pixel_size_m": measured.scan.views.pixel_size,
        "held_out": int(measured.scan.is_test.sum()),
        **dict(zip(("true_delta", "true_beta"), mean_inside(measured.truth, measured.truth))),
        **environment(resolve("auto")),
        "commit": source_commit(),
    }


def run_configuration(
    measured: Measured,
    configuration: Configuration,
    pace: Pace,
    seed: int,
    folder: StudyFolder,
    on_progress: FitProgress = lambda name, fraction, record: None,
) -> None:
    """Fit one configuration to the training frames, look at the held-out ones on the way, and write all of it.

    The looks judge only: nothing is chosen or stopped by them. A fit that diverges is a result, and said so.
    """
    name, train = configuration.name, measured.scan.train()
    start = random_start(configuration, train.views, train.exposures.one_energy("the thesis' study"), seed)
    recipe = pace.recipe(configuration, train.views.shape[1], float(start.strength.mean()))
    folder.write_config(name, {"configuration": asdict(configuration), "seed": seed, "recipe": asdict(recipe)})
    watched = _Watched(thesis_fit(train, start, recipe, seed), measured)
    watched.go_on(folder.load_checkpoint(name))
    diverged, saved = None, time.monotonic()
    steps = recipe.fit.schedule.steps
    try:
        while not watched.fit.finished:
            watched.advance(pace.look_every, lambda record: on_progress(name, watched.fit.step / steps, record))
            if time.monotonic() - saved >= SAVE_EVERY_S:
                folder.write_curves(name, watched.seen)
                folder.save_checkpoint(name, watched.state())
                saved = time.monotonic()
    except DivergedError as error:
        diverged = error.step
    folder.write_curves(name, watched.seen)
    folder.write_maps(name, looks.maps(watched.lines, looks.geometry(watched.fit, measured), measured))
    folder.write_row(name, _row(configuration, watched, diverged))


class _Watched:
    """A fit, and what was seen of it: a look at every score, and the line integrals now and then."""

    def __init__(self, fit: Fit, measured: Measured) -> None:
        self.fit, self._measured = fit, measured
        self.seen: list[dict[str, float]] = []
        self.lines: list[tuple[int, torch.Tensor]] = []
        self._loss = float("nan")

    def go_on(self, state: Mapping[str, Any] | None) -> None:
        """Go back to a saved state, or look at the start."""
        if state is None:
            self._look(-1)
            return
        self.fit.load(state["fit"])
        self.seen, self.lines = list(state["seen"]), list(state["lines"])

    def state(self) -> dict[str, Any]:
        """What `go_on` takes."""
        return {"fit": self.fit.state_dict(), "seen": self.seen, "lines": self.lines}

    def advance(self, steps: int, report: Any) -> None:
        """Run `steps` more, and look."""
        before = self.fit.step

        def on_record(record: dict[str, float]) -> None:
            self._loss = float(record["loss"])
            report(record)

        self.fit.run(on_record, until=before + steps)
        self._look(before)

    def _look(self, before: int) -> None:
        self.seen.append(looks.scores(self.fit, self._measured, self._loss))
        if looks.due(self.fit.step, before, self.fit.schedule.steps):
            self.lines.append((self.fit.step, looks.line_integrals(looks.cloud_of(self.fit), self._measured)))


def thesis_fit(train: Scan, start: DenseCloud, recipe: Recipe, seed: int) -> Fit:
    """The fit of `start` to the frames `train`, made ready."""
    plan, _ = gaussian_plan(train, start, recipe.fit)
    return Fit(replace(plan, rates=recipe.rates), seed)


def random_start(configuration: Configuration, views: Views, energy_kev: float, seed: int) -> DenseCloud:
    """Two-channel Gaussians at uniformly random places of the field of view's box, all alike, and faint.

    Their size is half the mean distance between neighbours; δ and β are water's, the density makes them faint.
    """
    grid, count = Grid.of_views(views), configuration.count
    generator = torch.Generator().manual_seed(seed)
    extent = torch.tensor([float(n) for n in grid.shape[::-1]])
    middle = torch.from_numpy(grid.centre / views.pixel_size).float()
    centres = (torch.rand(count, 3, generator=generator) - 0.5) * extent + middle
    sigma = 0.5 * (float(extent.prod()) / count) ** (1 / 3)
    density = START_DENSITY * float(extent.prod()) / count / ((2 * np.pi) ** 1.5 * sigma**3)
    parameters = (
        centres,
        torch.full((count, 3), float(np.log(sigma))),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        raw_of(torch.ones(count, 2)),
        raw_of(torch.full((count, 1), density)),
    )
    water = WATER.delta_beta(energy_kev)
    matter = Matter.free(water.delta, water.delta if configuration.one_unit else water.beta)
    return DenseCloud(parameters, views.pixel_size, matter)


def _row(configuration: Configuration, watched: _Watched, diverged: int | None) -> dict[str, Any]:
    """The final row: the last look and the one of the best held-out FRCM, where an early stop would end, and what it
    took; `diverged_at` is the step where the fit broke down, or None."""
    seen = watched.seen
    best = max(seen, key=lambda look: look["test_frcm"] if np.isfinite(look["test_frcm"]) else -1.0)
    return {
        "configuration": asdict(configuration),
        "status": "done" if diverged is None else "diverged",
        "diverged_at": diverged,
        "steps": watched.fit.step,
        "seconds": watched.fit.seconds,
        "commit": source_commit(),
        "last": _plain(seen[-1]),
        "best": _plain(best),
    }


def _plain(look: Mapping[str, float]) -> dict[str, float | None]:
    """A look as JSON holds it."""
    rounded = {key: float(f"{look[key]:.6g}") for key in CURVES}
    return {key: value if np.isfinite(value) else None for key, value in rounded.items()}
