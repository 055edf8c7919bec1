"""Training of the network of `motion.learned` on series that `holosplat grow --compact` made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor, nn

from holosplat.beamline.grow import SeriesFolder, read_compact
from holosplat.checks import as_written, require
from holosplat.io.atomic import read_json
from holosplat.learning.start import Card
from holosplat.mesh import ball_radius
from holosplat.motion.elastic import vertex_normals
from holosplat.motion.learned import (
    DEGREE,
    LONGEST,
    RELAXATION,
    Dynamics,
    DynamicsSize,
    Scene,
    ahead_of,
    base,
    spread_of,
    write_dynamics,
)

from .shown import Judge
from .train import WEIGHTS, Training

SIZE = DynamicsSize()
"""Of the network."""
WINDOWS = (12, 16, 20, 24)
"""Snapshots of a window."""
BODIES = 48
"""Bodies of a step, neighbours along the channel."""
HORIZONS = 6
"""Times ahead that a step compares."""
EXACT, NOISE = 0.3, (0.002, 0.05)
"""Share of steps without noise, and the range of its standard error [radii] in others."""
SLIDE = 3.0
"""Greatest ratio of noise along surfaces to that across: where a membrane's nodes are is not seen."""
MODES, WAVE = 8, 2.0
"""Waves of the noise over a body, and their wave number [1/radii]: errors of tracks are smooth."""
ALONG = 0.05
"""What errors along surfaces count beside those across."""
NOISES, ASKED = (0.0, 0.02), (5, 10, 15, 25)
"""What is validated: standard errors of the state [radii], snapshots ahead of a window of 24."""


@dataclass(frozen=True)
class Series:
    """nodes: [T, C, P, 3] m, along the channel in order; faces: [F, 3]; times: [T] s."""

    nodes: Tensor
    faces: Tensor
    times: np.ndarray

    @cached_property
    def radius(self) -> float:
        """Of a ball of a cell's volume [m]."""
        a, b, c = self.nodes[0, 0][self.faces].unbind(-2)
        return ball_radius(float((a * torch.linalg.cross(b, c)).sum() / 6))

    def on(self, device: str) -> Series:
        """The same on a device."""
        return replace(self, nodes=self.nodes.to(device), faces=self.faces.to(device))


@dataclass(frozen=True)
class FlowSeries:
    """Folders of `grow --compact` in a folder. ranges: what each was grown with, by its name."""

    folders: tuple[Path, ...]
    ranges: dict[str, Any]
    device: str = "cpu"
    seed: int = 0

    @classmethod
    def read(cls, folder: Path, device: str = "cpu") -> FlowSeries:
        """All series in `folder`; `InputError` for fewer than two."""
        found = tuple(sorted(path.parent for path in folder.glob("*/grow.json")))
        require(
            len(found) > 1, f"{folder} must hold folders of holosplat grow --compact, two at least, but it does not."
        )
        return cls(found, {path.name: read_json(path / "grow.json") for path in found}, device)

    @property
    def count(self) -> int:
        """Series that are trained on: all but every eighth, which validate, and one at least does."""
        return len(self.folders) - len(self.held_out)

    @property
    def held_out(self) -> list[int]:
        """Numbers of the series that validate."""
        return list(range(len(self.folders)))[:: max(2, min(8, len(self.folders) // 2 + 1))]

    @cached_property
    def _all(self) -> list[Series]:
        return [_series(folder).on(self.device) for folder in self.folders]

    def sample(self, index: int) -> Series:
        """A series that is trained on."""
        kept = [k for k in range(len(self.folders)) if k not in self.held_out]
        return self._all[kept[index]]

    def validation(self) -> list[Series]:
        """Those that are not."""
        return [self._all[k] for k in self.held_out]


def _series(folder: Path) -> Series:
    nodes, faces, times = read_compact(SeriesFolder(folder))
    with as_written(folder, "a series of holosplat grow --compact"):
        least = max(WINDOWS) + max(ASKED) + 1
        require(len(times) >= least, f"{folder} must have {least} snapshots at least, but it has {len(times)}.")
        order = np.argsort(nodes[0, :, :, 0].mean(1))
        return Series(torch.from_numpy(nodes[:, order]), torch.from_numpy(faces.astype(np.int64)), times)


@dataclass(frozen=True)
class Lesson:
    """scene: with noise; normals: [B, n, H, 3] of the truth; truth: [B, n, H, 3] radii; horizon: [H] windows."""

    scene: Scene
    truth: Tensor
    normals: Tensor
    horizon: Tensor

    def errors(self, network: Dynamics) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements missed along normals and at all, squared, and the standard error, each [B, n, H]."""
        scene = self.scene
        found, spread = network(scene)
        found = found + network.direct(scene.own, scene.middle, scene.normals)
        missed = ahead_of(found, self.horizon) + base(scene.own, scene.middle, self.horizon) - self.truth
        return (missed * self.normals).sum(-1).square(), missed.square().sum(-1), spread_of(spread, self.horizon)


def lesson(
    series: Series,
    first: int,
    window: int,
    stride: int = 1,
    *,
    horizons: np.ndarray,
    noise: float,
    cells: slice,
    rng: np.random.Generator,
) -> Lesson:
    """A window from snapshot `first` on, in `window` steps of `stride`, and the snapshots `horizons` after it."""
    past = first + stride * np.arange(window)
    ahead = past[-1] + horizons
    length = float(series.times[past[-1]] - series.times[past[0]])
    radius = series.radius
    nodes = series.nodes[np.r_[past, ahead]][:, cells]
    device = nodes.device
    nodes = (nodes - nodes[window - 1, 0].mean(0)) / radius
    scaled = np.linspace(-1, 1, window)
    fit = torch.from_numpy(np.linalg.pinv(legendre.legvander(scaled, DEGREE))).to(nodes)
    whole = torch.einsum("kt,tbnx->bnkx", fit, nodes[:window])
    truth = nodes[window:].permute(1, 2, 0, 3)
    normals = vertex_normals(nodes[window:], series.faces).permute(1, 2, 0, 3)
    if noise:
        whole = whole + _noise(whole, vertex_normals(whole.sum(2), series.faces), noise, rng)
    middle = whole.mean(1)
    own = whole - middle[:, None]
    seen = vertex_normals(own.sum(2), series.faces)
    bodies = len(own)
    said = [torch.full((bodies,), value, device=device) for value in (length / (RELAXATION * radius), noise)]
    scene = Scene.of(*(part.float() for part in (own, middle, seen, *said)))
    horizon = torch.from_numpy((series.times[ahead] - series.times[past[-1]]) / length).float().to(device)
    return Lesson(scene, truth.float(), normals.float(), horizon)


def _noise(whole: Tensor, normals: Tensor, noise: float, rng: np.random.Generator) -> Tensor:
    """Smooth errors [B, n, D + 1, 3] radii of the coefficients, of standard error `noise` across the surfaces."""

    def draw(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape)).to(whole)

    bodies, _, count, _ = whole.shape
    local = whole[:, :, 0] - whole[:, :, 0].mean(1, keepdim=True)
    phase = torch.einsum("bnx,bxm->bnm", local, WAVE * draw(bodies, 3, MODES))
    waves = torch.cat([torch.ones_like(local[..., :1]), local, phase.sin(), phase.cos()], dim=-1)
    drawn = torch.einsum("bnm,bmkx->bnkx", waves, draw(bodies, waves.shape[-1], count, 3))
    across = (drawn * normals[:, :, None]).sum(-1, keepdim=True) * normals[:, :, None]
    drawn = across + float(rng.uniform(1, SLIDE)) * (drawn - across)
    size = across.sum(2).square().sum(-1).mean(1).sqrt()
    return noise * drawn / size[:, None, None, None]


class DynamicsTraining(Training):
    """A training of the network of `--by graph`: the likelihood of where nodes are later, across surfaces."""

    columns: ClassVar[tuple[str, ...]] = ("step", "loss", "missed", "thought", "rate")

    data: FlowSeries  # pyright: ignore[reportIncompatibleVariableOverride]

    def _made(self) -> nn.Module:
        return Dynamics(SIZE)

    def _value(self, sample: Series, rng: np.random.Generator) -> tuple[Tensor, list[float]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        assert isinstance(self.network, Dynamics)
        drawn = draw_lesson(sample, rng)
        across, missed, thought = drawn.errors(self.network)
        square = across + ALONG * missed
        value = (0.5 * square / thought.square() + thought.log()).mean()
        return value, [float(across.detach().mean().sqrt()), float(thought.detach().mean())]

    def _precision(self) -> AbstractContextManager[Any]:
        return nullcontext()

    def finish(self, validation: DynamicsValidation, made_by: dict[str, str]) -> Path:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Write the weights with their card; their file."""
        assert isinstance(self.network, Dynamics)
        path, how = self.folder / WEIGHTS, self.options
        card = validation.card(self.network, self.data.ranges, made_by)
        said = {"steps": how.steps, "rate": how.rate, "seed": how.seed, "bodies": BODIES}
        write_dynamics(path, self.network, replace(card, training=said))
        return path


def draw_lesson(series: Series, rng: np.random.Generator) -> Lesson:
    """A window, horizons and noise at random."""
    window = int(rng.choice(WINDOWS))
    longest = len(series.times) - 1
    stride = 2 if rng.random() < 0.3 and longest > 3 * window else 1
    most = min(int(LONGEST * stride * (window - 1)), longest - stride * (window - 1))
    first = int(rng.integers(longest - stride * (window - 1) - max(most // 2, 1)))
    most = min(most, longest - first - stride * (window - 1))
    horizons = np.sort(rng.integers(1, most + 1, HORIZONS))
    noise = 0.0 if rng.random() < EXACT else float(np.exp(rng.uniform(*np.log(NOISE))))
    start = int(rng.integers(max(1, series.nodes.shape[1] - BODIES + 1)))
    cells = slice(start, start + BODIES)
    return lesson(series, first, window, stride, horizons=horizons, noise=noise, cells=cells, rng=rng)


@dataclass
class DynamicsValidation(Judge):
    """Series that were not trained on, and errors there [radii], across surfaces: rows of step, noise, snapshots ahead,
    error of the network, error that it states, and of a quadratic through the last third of the window."""

    columns: ClassVar[tuple[str, ...]] = ("step", "noise", "ahead", "missed", "thought", "quadratic")

    samples: Sequence[Series]

    def judge(self, network: nn.Module, step: int) -> None:
        """A row for each noise and time ahead."""
        assert isinstance(network, Dynamics)
        with torch.no_grad():
            for noise in NOISES:
                found = np.mean([_judged(network, one, noise) for one in self.samples], axis=0)
                self.rows += [(step, noise, ahead, *map(float, row)) for ahead, row in zip(ASKED, found.T**0.5)]

    def last(self) -> str:
        """The newest rows in words."""
        said = self.rows[-len(ASKED) * len(NOISES) :]
        return ", ".join(f"{ahead} ahead at noise {noise:g}: {missed:.4f}" for _, noise, ahead, missed, *_ in said)

    def card(self, network: nn.Module, trained_on: dict[str, Any], made_by: dict[str, str]) -> Card:
        """What `network` scores here, and what its standard errors are to be multiplied by."""
        self.judge(network, 0)
        rows = [self.rows.pop() for _ in range(len(ASKED) * len(NOISES))][::-1]
        scores: dict[str, dict[str, float]] = {}
        for _, noise, ahead, missed, thought, quadratic in rows:
            said = {"missed": missed, "thought": thought, "quadratic": quadratic}
            scores.setdefault(str(ahead), {}).update({f"{name}, noise {noise:g}": v for name, v in said.items()})
        ratio = float(np.sqrt(np.mean([(missed / thought) ** 2 for *_, missed, thought, _ in rows])))
        words = (
            "It knows red cells of healthy moduli in dilute suspension in straight channels, in windows of 12 to 24 "
            "snapshots of 1 µm of way, and horizons of 1.2 windows; of other bodies and flows its forecasts may be "
            "wrong, and worse than paths that go on."
        )
        return Card(trained_on, {}, made_by, scores, {"spread": ratio}, words)


def _judged(network: Dynamics, series: Series, noise: float) -> np.ndarray:
    """[3, len(ASKED)] mean squares: missed, stated, missed by a quadratic."""
    rng = np.random.default_rng(0)
    firsts = range(0, len(series.times) - max(WINDOWS) - max(ASKED), 8)
    found = []
    for first in firsts:
        how = {"horizons": np.array(ASKED), "noise": noise, "cells": slice(0, BODIES), "rng": rng}
        drawn = lesson(series, first, max(WINDOWS), **how)
        across, _, thought = drawn.errors(network)
        found.append([across.mean((0, 1)), thought.square().mean((0, 1)), _quadratic(drawn)])
    return np.array([[part.cpu().numpy() for part in row] for row in found]).mean(0)


def _quadratic(drawn: Lesson) -> Tensor:
    """[H] mean square error of a parabola through the last third of the window."""
    whole = (drawn.scene.own + drawn.scene.middle[:, None]).double()
    scaled = np.linspace(1 / 3, 1, 8)
    values = torch.from_numpy(legendre.legvander(scaled, DEGREE)).to(whole)
    later = np.vander(1 + 2 * drawn.horizon.cpu().double().numpy(), 3)
    said = torch.from_numpy(later @ np.linalg.pinv(np.vander(scaled, 3))).to(whole) @ values
    missed = torch.einsum("hk,bnkx->bnhx", said, whole) - drawn.truth
    return (missed * drawn.normals).sum(-1).square().mean((0, 1))


def train_dynamics(
    folder: Path, out: Path, options: Any, resume: bool, on_step: Callable[[Training], None], who: dict[str, str]
) -> tuple[Path, DynamicsValidation]:
    """Train on the series in `folder` into `out`; the weights' file, and the validation."""
    data = FlowSeries.read(folder, options.device)
    told = DynamicsValidation(data.validation())
    training = (DynamicsTraining.resumed if resume else DynamicsTraining.begun)(data, out, options)  # pyright: ignore[reportArgumentType]
    training.run(told, on_step)
    return training.finish(told, who), told
