"""What most of a short run goes into, computed once for the same frames: kind and level of the matter, first volumes.

The first answer is the program's own; whoever asks the same again gets it back, with the same progress.
tests/methods/test_levels.py and tests/baselines hold what is computed, tests/house/test_once.py that nothing else is.
"""

from __future__ import annotations

import contextlib
import importlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from torch import Tensor

from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.baselines.material import estimate_delta
from holosplat.geometry import Grid
from holosplat.inference import Decision
from holosplat.matter import DeltaBeta
from holosplat.methods import Task
from holosplat.methods.contrast import (
    BELOW,
    BOTH,
    SPHERICAL,
    Scoring,
    decide_sides,
    decide_sign,
    with_sign,
    with_usual_steps,
)
from holosplat.methods.cross_validation import FirstVolumes, unseen_ratio
from holosplat.methods.illumination import decided
from holosplat.methods.levels import decide_matter
from holosplat.methods.volume import material_of_levels
from holosplat.optics.background import Light
from holosplat.progress import Progress
from holosplat.scan import Scan
from holosplat.workflows.provenance import scan_hash

Key = tuple[object, ...]
KEPT = 32
"""Answers that are kept, the latest ones: a first volume of the tests has up to a million voxels."""


class Once:
    """Answers by what was asked, with the progress that was told on the way."""

    def __init__(self) -> None:
        self.made: OrderedDict[Key, tuple[Any, list[tuple[str, float]]]] = OrderedDict()

    def answer(self, key: Key, compute: Callable[[Progress], Any], on_progress: Progress) -> Any:
        """That of `compute(progress)`, or of an earlier one for the same `key`; what fails is not kept."""
        if key in self.made:
            self.made.move_to_end(key)
            for step in self.made[key][1]:
                on_progress(*step)
        else:
            told: list[tuple[str, float]] = []

            def progress(stage: str, fraction: float) -> None:
                told.append((stage, fraction))
                on_progress(stage, fraction)

            self.made[key] = compute(progress), told
            if len(self.made) > KEPT:
                self.made.popitem(last=False)
        return self.made[key][0]


def of(scan: Scan) -> Key:
    """What tells frames from others: what they show, and how they were taken."""
    return scan_hash(scan), scan.frames.shape


@contextlib.contextmanager
def once(memory: Once) -> Iterator[None]:
    """Within, runs take from `memory` what an earlier run on the same frames has found; uneven light is left alone."""

    def decide(task: Task, *how: Any) -> Decision:
        if task.uneven is not None:
            return decide_matter(task, *how)
        key = ("kind", *of(task.scan), task.prior, repr(how))
        return memory.answer(key, lambda told: decide_matter(replace(task, on_progress=told), *how), task.on_progress)

    def light(first: FirstVolumes, *how: Any) -> Any:
        key = ("light", *of(first.folds.scan), first.prior, *how)
        return memory.answer(key, lambda told: decided(replace(first, on_progress=told), *how), first.on_progress)

    def sign(first: FirstVolumes, *scores: Scoring, fitted: Scoring) -> Any:
        def compute(told: Progress) -> tuple[Decision, ...]:
            return decide_sign(replace(first, on_progress=told), *scores, fitted=fitted)[1]

        made = memory.answer(("sign", *of(first.folds.scan), first.prior), compute, first.on_progress)
        above = not any(each.choice == BELOW for each in made)
        prior = with_sign(first.prior, made)
        return (first if above else FirstVolumes(first.folds, prior, first.on_progress, first.options)), made

    def sides(first: FirstVolumes, *how: Any) -> Any:
        key = ("sides", *of(first.folds.scan), first.prior, first.taken, *how)

        def compute(told: Progress) -> Decision:
            return decide_sides(replace(first, on_progress=told), *how)[1]

        made = memory.answer(key, compute, first.on_progress)
        if made.choice not in (BOTH, SPHERICAL):
            return first, made
        two = with_usual_steps(first, first.prior.on_both_sides())
        return FirstVolumes(two.folds, with_sign(two.prior, (made,)), two.on_progress, two.options), made

    def ratio(first: FirstVolumes) -> tuple[float, Decision]:
        key = ("ratio", *of(first.folds.scan), first.prior, first.options)
        return memory.answer(key, lambda told: unseen_ratio(replace(first, on_progress=told)), first.on_progress)

    def delta(scan: Scan, known: float, on_progress: Progress, *how: Any) -> float:
        key = ("delta", *of(scan), known, *how)
        return memory.answer(key, lambda told: estimate_delta(scan, known, told, *how), on_progress)

    def level(task: Task, *how: Any) -> DeltaBeta:
        if task.uneven is not None:
            return material_of_levels(task, *how)
        key = ("level", *of(task.scan), task.prior, task.matter, *how)
        return memory.answer(
            key, lambda told: material_of_levels(replace(task, on_progress=told), *how), task.on_progress
        )

    def begin(
        scan: Scan,
        material: DeltaBeta,
        options: HolographicTV,
        on_progress: Progress,
        light: Light | None = None,
        lines: Tensor | None = None,
    ) -> tuple[Tensor, Grid]:
        how = scan, material, options
        if light is not None:
            return holographic_tv(*how, on_progress, light, lines=lines)
        key = ("volume", *of(scan), material, options, lines is None)
        values, grid = memory.answer(key, lambda told: holographic_tv(*how, told, lines=lines), on_progress)
        return values.clone(), grid

    shared = {
        "solve.decide_matter": decide,
        "illumination.decided": light,
        "illumination.decide_sign": sign,
        "illumination.decide_sides": sides,
        "cross_validation.unseen_ratio": ratio,
        "cross_validation.estimate_delta": delta,
        "start.material_of_levels": level,
        **{f"{module}.holographic_tv": begin for module in ("start", "volume", "voxels")},
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, act in shared.items():
            module, function = name.split(".")
            patch.setattr(importlib.import_module(f"holosplat.methods.{module}"), function, act)
        yield
