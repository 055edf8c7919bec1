"""The thesis' study, rerun: its configurations, its schedule and loss, and curves of every score over steps."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.backends import resolve
from holosplat.checks import require
from holosplat.fit.loop import DivergedError, Fit
from holosplat.geometry import Grid, Views
from holosplat.materials import WATER
from holosplat.matter import Matter
from holosplat.methods import finished
from holosplat.methods.gaussians import gaussian_plan
from holosplat.progress import FitProgress
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.scan import Scan
from holosplat.units import wavenumber
from holosplat.version import source_commit
from holosplat.volume import Object
from holosplat.workflows.evaluate import score_object
from holosplat.workflows.provenance import environment, scan_hash

from .configurations import THESIS_TABLE, Configuration, Measured, Pace, Recipe, mean_inside
from .folder import CURVES, StudyFolder


class DenseCloud(GaussianCloud):
    """Gaussians of peak values d δ and d β: density d, δ and β are parameters each, all through softplus.

    raw_densities [N, 1]: d before softplus, beside the parameters of `GaussianCloud`, whose raw_amplitudes are those of
    δ and β, in the units of `matter`. d goes down alone when Gaussians are cloned or split, and says which are faint.
    Errors: `InputError` if the arrays do not fit together.
    """

    names = (*PARAMETERS, "raw_densities")

    def __init__(self, parameters: Iterable[Tensor], unit_length: float, matter: Matter) -> None:
        *shared, self.raw_densities = parameters
        super().__init__(shared, unit_length, matter)
        shape = tuple(self.raw_densities.shape)
        require(shape == (len(self), 1), f"raw_densities must have the shape ({len(self)}, 1), but they have {shape}.")

    @property
    def densities(self) -> Tensor:
        """d [N, 1]."""
        return softplus(self.raw_densities)

    @property
    def values(self) -> Tensor:
        """δ and β [N, 2] of each Gaussian, in the units of the matter."""
        return softplus(self.raw_amplitudes)

    @property
    def amplitudes(self) -> Tensor:
        """Peak values d δ and d β [N, 2]."""
        return self.densities * self.values

    @property
    def strength(self) -> Tensor:
        """What says whether a Gaussian is faint, [N]: its density."""
        return self.densities[:, 0]

    def values_times(self, factor: float, index: Tensor) -> dict[str, Tensor]:
        """The parameters of the Gaussians `index` whose density is `factor` times theirs, with δ and β as they are."""
        weaker = raw_of(self.densities.detach()[index] * factor)
        return {"raw_amplitudes": self.raw_amplitudes.detach()[index], "raw_densities": weaker}

    def ratios(self) -> Tensor:
        """δ/β [N] of each Gaussian, as its parameters have them."""
        with torch.no_grad():
            delta, beta = self.values.double().unbind(1)
            smallest = torch.finfo(torch.float64).tiny
            return self.matter.delta * delta / (self.matter.beta * beta).clamp_min(smallest)

    def state(self) -> dict[str, Any]:
        """Plain Gaussians with the same peak values, which files can hold."""
        return self.plain().state()

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> GaussianCloud:  # type: ignore[override]
        """The plain Gaussians that `state` described."""
        return GaussianCloud.from_state(state)

    def plain(self) -> GaussianCloud:
        """Gaussians with the same peak values and no densities of their own."""
        kept = [getattr(self, name).detach() for name in PARAMETERS[:3]]
        return GaussianCloud([*kept, raw_of(self.amplitudes.detach())], self.unit_length, self.matter)


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
    folder.write_maps(name, maps(watched.lines, geometry(watched.fit, measured), measured))
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
        self.seen.append(scores(self.fit, self._measured, self._loss))
        if due(self.fit.step, before, self.fit.schedule.steps):
            self.lines.append((self.fit.step, line_integrals(cloud_of(self.fit), self._measured)))


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


SHOWN = (0.0, 0.04, 0.1, 0.25, 0.5, 1.0)
"""Shares of the steps after which the line integrals are kept: the start, the warm-up behind it, the first
densification, two on the way, and the end."""


def scores(fit: Fit, measured: Measured, loss: float) -> dict[str, float]:
    """All scores of the cloud as it is now; loss: that of the last step."""
    cloud = cloud_of(fit)
    found = score_object(cloud, measured.scan, measured.truth, fit.oversample)
    assert found.test is not None
    assert found.train is not None
    assert found.volume is not None
    delta, beta = mean_inside(cloud.voxelise(measured.truth.grid), measured.truth)
    ratios = cloud.ratios()
    return {
        "step": fit.step,
        "seconds": fit.seconds,
        "count": len(cloud),
        **{f"test_{score}": value for score, value in found.test.mean.items()},
        **{f"train_{score}": value for score, value in found.train.mean.items()},
        "loss": loss,
        "dice": found.volume.dice,
        "relative_error_delta": found.volume.relative_error_delta,
        "mean_delta": delta,
        "mean_beta": beta,
        "ratio": delta / beta if beta > 0 else float("inf"),
        "own_ratio": float(ratios.mean()) if len(cloud) else float("nan"),
        "median_own_ratio": float(ratios.median()) if len(cloud) else float("nan"),
    }


def line_integrals(obj: Object, measured: Measured) -> torch.Tensor:
    """k ∫δ and k ∫β [2, H, W] of `obj` in the first held-out view, float32: phase shift, and half the absorbance."""
    exposures = measured.scan.test().exposures[np.array([0])]
    with torch.no_grad():
        beta, delta = obj.project(exposures.views)
    return (float(wavenumber(exposures.energy_kev)[0]) * torch.cat((delta, beta))).float()


def geometry(fit: Fit, measured: Measured) -> dict[str, np.ndarray]:
    """A slice of δ through the middle of the field, and that of the truth [Y, X]."""
    cloud, grid = cloud_of(fit), measured.truth.grid
    middle = grid.shape[0] // 2
    return {
        "slice": cloud.voxelise(grid).delta[middle].astype(np.float32),
        "true_slice": measured.truth.delta[middle].astype(np.float32),
    }


def maps(
    taken: Sequence[tuple[int, torch.Tensor]], shapes: dict[str, np.ndarray], measured: Measured
) -> dict[str, np.ndarray]:
    """What NAME.maps.npz holds: `steps` [K] and `lines` [K, 2, H, W] of `taken`, `true_lines`, and the geometry."""
    return {
        "steps": np.array([step for step, _ in taken]),
        "lines": torch.stack([lines for _, lines in taken]).numpy(),
        "true_lines": line_integrals(measured.scene, measured).numpy(),
        **shapes,
    }


def due(step: int, before: int, steps: int) -> bool:
    """Whether one of the `SHOWN` shares of `steps` lies behind `before` and not behind `step`."""
    return any(before < share * steps <= step for share in SHOWN)


def cloud_of(fit: Fit) -> DenseCloud:
    """The cloud as it is now, in main memory."""
    cloud = finished(fit)
    assert isinstance(cloud, DenseCloud)
    return cloud
