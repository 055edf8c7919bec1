"""The figure of a training: its loss, and scores of scenes that it did not see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from holosplat.checks import as_written
from holosplat.io.atomic import atomic_path
from holosplat.report.style import CYCLE, DPI, INK, WIDTH, letter, new_figure, styled
from holosplat.tables import read_rows

SMOOTHED = 100
"""Steps over which the noisy course is averaged: steps see one scene each."""
FILE = "curves.png"


def training_curves(folder: Path) -> Path:
    """Draw curves.csv and validation.csv of a training's `folder`; the figure's file."""
    curves, scores = (_columns(folder / name) for name in ("curves.csv", "validation.csv"))
    path = folder / FILE
    with atomic_path(path) as temporary:
        _figure(curves, scores).savefig(temporary, format="png", dpi=DPI)
    return path


@styled
def _figure(curves: dict[str, np.ndarray], scores: dict[str, np.ndarray]) -> Figure:
    figure = new_figure(WIDTH, 2.3)
    left, right = figure.subplots(1, 2)
    left.plot(curves["step"], _smooth(curves["loss"]), color=INK, lw=1.0)
    left.set(xlabel="step", ylabel="loss", yscale="log" if (curves["loss"] > 0).all() else "linear")
    letter(left, 0, f"What is minimised, mean of {SMOOTHED} steps")
    of_views = "views" in scores
    key, value, unit = ("views", "dice", "views") if of_views else ("ahead", "missed", "snapshots ahead")
    for colour, count in zip(CYCLE, np.unique(scores[key])):
        of = scores[key] == count
        steps = np.unique(scores["step"][of])
        means = [scores[value][of & (scores["step"] == step)].mean() for step in steps]
        right.plot(steps, means, color=colour, marker="o", ms=2.2, label=f"{count:.0f} {unit}")
    right.set(xlabel="step", ylabel="Dice" if of_views else "error across surfaces / radii")
    right.set(**{"ylim": (0, 1)} if of_views else {"yscale": "log"})
    right.legend(loc="lower right" if of_views else "upper right")
    letter(right, 1, "Scenes that were not trained on")
    return figure


def _smooth(values: np.ndarray) -> np.ndarray:
    """The mean of the last `SMOOTHED` values at each."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(len(values)) + 1 - SMOOTHED, 0)
    last = np.arange(len(values)) + 1
    return (sums[last] - sums[first]) / (last - first)


def _columns(path: Path) -> dict[str, np.ndarray]:
    with as_written(path, "the curves of a training"):
        rows = read_rows(path, "the curves of a training")
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
