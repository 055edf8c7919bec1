"""The plots: correlation curves, the course of fits, histograms. Each function returns a figure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..metrics import FIXED_THRESHOLD, ImageScores, VolumeScores, resolution
from ..volume import Volume
from .content import DELTA, Quantity
from .style import (
    CYCLE,
    FAINT,
    INK,
    RECONSTRUCTION,
    TRUTH,
    WIDTH,
    decimal_scale,
    format_length,
    letter,
    new_figure,
    scientific,
    styled,
)

NOT_TERMS = ("step", "seconds", "loss", "count", "lr", "learning_rate", "memory", "val_", "voxel_px")
"""Columns of the history, or their beginnings, that are not terms of the loss."""
SCORE_NAMES = {"ssim": "SSIM", "frcm": "FRCM", "dice": "Dice", "psnr": "PSNR", "l1": "L1"}


@styled
def correlation_figure(
    images: ImageScores | None,
    volume: VolumeScores | None,
    pixel_size: float,
    named: str = "Volume against the truth",
) -> Figure:
    """FRC of the test views (mean, least, greatest) and FSC of δ, with thresholds; pixel_size [m]; named: what the FSC
    is of."""
    panels = [scores for scores in (images, volume) if scores is not None]
    figure = new_figure(WIDTH if len(panels) > 1 else 0.55 * WIDTH, 2.55)
    axes = list(np.atleast_1d(figure.subplots(1, max(len(panels), 1))))
    if images is not None:
        _ring_panel(axes[0], images, pixel_size)
        letter(axes[0], 0, "Held-out views", lift=20)
    if volume is not None:
        _shell_panel(axes[-1], volume)
        letter(axes[-1], len(panels) - 1, named, lift=20)
    return figure


def _ring_panel(axes: Axes, scores: ImageScores, pixel_size: float) -> None:
    frequency, mean = scores.frequency / pixel_size * 1e-6, scores.frc.mean(axis=0)
    if len(scores) > 1:
        band = (scores.frc.min(axis=0), scores.frc.max(axis=0))
        axes.fill_between(frequency, *band, color=RECONSTRUCTION, alpha=0.18, lw=0, label="least to greatest")
    axes.plot(frequency, mean, color=RECONSTRUCTION, label="FRC, mean" if len(scores) > 1 else "FRC")
    length = resolution(scores.frequency, mean, scores.half_bit, pixel_size)
    _threshold(axes, frequency, scores.half_bit, "½-bit", length)
    _correlation_axes(axes, frequency, "Fourier ring correlation", float(scores.frc.min()))


def _shell_panel(axes: Axes, scores: VolumeScores) -> None:
    frequency = scores.frequency / scores.pitch * 1e-6
    axes.plot(frequency, scores.fsc, color=RECONSTRUCTION, label="FSC")
    _threshold(axes, frequency, scores.half_bit, "½-bit", scores.resolution_half_bit)
    fixed = np.full_like(frequency, FIXED_THRESHOLD)
    _threshold(axes, frequency, fixed, str(FIXED_THRESHOLD), scores.resolution_fixed, FAINT, (0, (1, 1.5)))
    _correlation_axes(axes, frequency, "Fourier shell correlation", float(scores.fsc.min()))


def _threshold(
    axes: Axes,
    frequency: np.ndarray,
    threshold: np.ndarray,
    name: str,
    length: float | None,
    colour: str = INK,
    dashes: tuple = (0, (4, 2)),
) -> None:
    """A threshold, with a dot where the curve falls below it and the resolution there in the legend."""
    crossed = length is not None and np.isfinite(length)
    said = ", not crossed" if length is None else f", {format_length(length)}" if crossed else ""
    axes.plot(frequency, threshold, color=colour, lw=0.8, ls=dashes, label=name + said)
    if crossed:
        at = 1e-6 / float(length or np.inf)
        axes.plot([at], [np.interp(at, frequency, threshold)], "o", ms=3.2, color=colour, zorder=5, clip_on=False)


def _correlation_axes(axes: Axes, frequency: np.ndarray, label: str, least: float) -> None:
    axes.set(xlim=(0, frequency[-1]), ylim=(min(-0.02, 1.1 * least), 1.03))
    axes.set(xlabel="spatial frequency (µm⁻¹)", ylabel=label)
    if least < 0:
        axes.axhline(0, color=FAINT, lw=0.4)
    axes.legend(loc="best")
    top = axes.secondary_xaxis("top")
    ticks = [t for t in axes.get_xticks() if 0 < t <= frequency[-1] * 1.001]
    top.set_xticks(ticks, [format_length(1e-6 / t) for t in ticks])
    top.spines["top"].set_visible(False)
    top.tick_params(length=0, pad=1, labelcolor=FAINT, labelsize=6)


@styled
def history_figure(history: Mapping[str, np.ndarray]) -> Figure | None:
    """Loss and its terms, validation scores, and number of primitives over steps; None if there are none.

    history: columns [S] of metrics.csv; NaN where a score was not taken.
    """
    columns = {name: np.asarray(column, dtype=np.float64) for name, column in history.items()}
    step = columns.get("step", np.arange(max((len(c) for c in columns.values()), default=0)))
    terms = [n for n in columns if not n.startswith(NOT_TERMS) and np.any(columns[n] > 0)]
    scores = [n for n in columns if n.startswith("val_") and n[4:] not in ("psnr", "l1") and _has(columns[n])]

    def known(*names: str) -> list[str]:
        return [name for name in names if name in columns and _has(columns[name])]

    plain = np.all(columns.get("loss", np.ones(1)) > 0)  # else it is a logarithm itself, as of surfaces
    panels = [
        ("Loss", known("loss") + terms, "loss", "log") if plain else ("Loss", known("loss"), "log of loss", "linear"),
        ("Validation scores", scores, "score", "linear"),
        ("Validation PSNR", known("val_psnr"), "PSNR (dB)", "linear"),
        ("Primitives", known("count"), "number of primitives", "linear"),
    ]
    panels = [panel for panel in panels if panel[1]]
    if not panels or len(step) < 2:
        return None
    figure = new_figure(WIDTH if len(panels) > 1 else 0.5 * WIDTH, 2.1)
    axes = np.atleast_1d(figure.subplots(1, len(panels)))
    for i, (title, names, label, scale) in enumerate(panels):
        _course(axes[i], step, {name: columns[name] for name in names}, scale)
        axes[i].set(xlabel="step", ylabel=label, xlim=(step[0], step[-1]))
        letter(axes[i], i, title)
    return figure


def _said(name: str) -> str:
    name = name.removeprefix("val_")
    return SCORE_NAMES.get(name, name.replace("_", " "))


def _has(column: np.ndarray) -> bool:
    return bool(np.isfinite(column).any())


def _course(axes: Axes, step: np.ndarray, columns: Mapping[str, np.ndarray], scale: str) -> None:
    axes.set_yscale(scale)
    for i, (name, column) in enumerate(columns.items()):
        taken = np.isfinite(column) & ((column > 0) | (scale != "log"))
        sparse = np.count_nonzero(taken) <= 40
        is_total = name == "loss"
        axes.plot(
            step[taken],
            column[taken],
            color=INK
            if is_total
            else RECONSTRUCTION
            if len(columns) == 1
            else CYCLE[(i - ("loss" in columns)) % len(CYCLE)],
            lw=1.2 if is_total else 0.9,
            marker="o" if sparse else None,
            ms=2.2,
            label="total" if is_total else _said(name),
        )
    if len(columns) > 1:
        axes.legend(loc="best")
    if scale == "linear" and min(float(np.nanmin(c)) for c in columns.values()) >= 0:
        top = max(float(np.nanmax(c)) for c in columns.values())
        axes.set_ylim(
            bottom=0 if next(iter(columns)) == "count" else None,
            top=None if top > 1 else min(1.02, top + 0.08),
        )


@styled
def histogram_figure(
    reconstruction: Volume, truth: Volume | None, material: float, quantity: Quantity = DELTA
) -> tuple[Figure, float | None]:
    """Histograms of δ/β over the matter, weighted by δ, and of δ over all voxels; of µ alone, over these.

    Matter is where δ exceeds half of the `material`'s. Returns the figure and the part of the mass whose δ/β
    falls outside of the drawn range, or None when no β is known (then only δ is drawn).
    """
    ratios = [_ratio_and_mass(v, material) for v in (reconstruction, truth) if v is not None]
    has_ratio = quantity == DELTA and ratios[0][0].size > 0
    figure = new_figure(WIDTH if has_ratio else 0.55 * WIDTH, 2.2)
    axes = list(np.atleast_1d(figure.subplots(1, 2 if has_ratio else 1)))
    outside = None
    if has_ratio:
        outside = _ratio_panel(axes[0], ratios)
        letter(axes[0], 0, "δ/β of the matter, weighted by δ")
    _delta_panel(axes[-1], reconstruction, truth, material, quantity)
    letter(axes[-1], len(axes) - 1, f"{quantity.symbol} of all voxels")
    return figure, outside


def _ratio_and_mass(volume: Volume, material: float) -> tuple[np.ndarray, np.ndarray]:
    matter = (volume.delta / material > 0.5) & (volume.beta != 0)
    delta, beta = volume.delta[matter].astype(np.float64), volume.beta[matter].astype(np.float64)
    return delta / beta, np.abs(delta)


def _ratio_panel(axes: Axes, ratios: list[tuple[np.ndarray, np.ndarray]]) -> float:
    values, mass = ratios[0]
    order = np.argsort(values)
    quantile = np.cumsum(mass[order]) / mass.sum()
    low, middle, high = (float(values[order][np.searchsorted(quantile, q)]) for q in (0.01, 0.5, 0.99))
    true = None
    if len(ratios) > 1 and ratios[1][0].size:
        true = float(ratios[1][1].sum() / np.sum(ratios[1][1] / ratios[1][0]))
        low, high = min(low, true), max(high, true)
    margin = max(0.06 * (high - low), 0.05 * abs(middle))  # one material: a line, not its rounding
    low, high = low - margin, high + margin
    weights, bins = mass / mass.sum() * 100, np.linspace(low, high, 60).tolist()
    axes.hist(
        values,
        bins,
        weights=weights,
        color=RECONSTRUCTION,
        alpha=0.3,
        lw=0,
        histtype="stepfilled",
    )
    axes.hist(values, bins, weights=weights, color=RECONSTRUCTION, histtype="step", lw=0.9)
    axes.axvline(middle, color=RECONSTRUCTION, lw=1.0, label=f"median, {scientific(middle, 4)}")
    if true is not None:
        axes.axvline(true, color=INK, lw=1.0, ls=(0, (4, 2)), label=f"truth, {scientific(true, 4)}")
    axes.set(xlabel="δ/β", ylabel="mass per bin (%)", xlim=(low, high))
    axes.margins(y=0.25)
    axes.legend(loc="upper right")
    return float(weights[(values < low) | (values > high)].sum()) / 100


def _delta_panel(axes: Axes, reconstruction: Volume, truth: Volume | None, material: float, quantity: Quantity) -> None:
    drawn = [(reconstruction, RECONSTRUCTION, "reconstruction")]
    if truth is not None:
        drawn.insert(0, (truth, TRUTH, "truth"))
    scale, power = decimal_scale(quantity.factor * material)
    scale /= quantity.factor
    ends = [np.quantile(v.delta, [0.0005, 0.9995]) for v, _, _ in drawn]
    reach = np.concatenate([*ends, [0.0, 1.15 * material]]) / scale
    edges = np.linspace(reach.min(), reach.max(), 90).tolist()
    for volume, colour, name in drawn:
        values = volume.delta.ravel() / scale
        filled = "stepfilled" if name == "truth" else "step"
        alpha = 0.35 if name == "truth" else 1.0
        axes.hist(values, edges, color=colour, histtype=filled, alpha=alpha, lw=1.0, label=name)
    axes.axvline(
        0.5 * material / scale, color=FAINT, lw=0.8, ls=(0, (1, 1.5)), label=f"half of the material's {quantity.symbol}"
    )
    axes.set_yscale("log")
    axes.set(xlabel=quantity.label(power), ylabel="voxels per bin", xlim=(edges[0], edges[-1]))
    axes.legend(loc="upper right")
