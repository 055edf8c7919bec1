"""The figures of the page with their captions; a sentence replaces a figure without data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from ..frames import evenly
from ..metrics import VolumeScores
from ..units import beam_named, in_percent, plain, wavenumber
from ..volume import Volume
from ..workflows.verdict import Verdict
from .content import UNSURE, GuessShown, ReportContent
from .curves import correlation_figure, histogram_figure, history_figure
from .figures import (
    held_out_figure,
    matter_block,
    plane_sizes,
    projections_figure,
    richest_planes,
    scene_figure,
    slice_row,
    slice_titles,
    slices_figure,
)
from .light import light_figure
from .moving_figures import motion_blocks
from .style import (
    CYCLE,
    DELTA_MAP,
    FAINT,
    INK,
    RECONSTRUCTION,
    WIDTH,
    Block,
    PanelGrid,
    colour_bar,
    drawn_block,
    format_length,
    grey_limits,
    in_print,
    largest,
    letter,
    new_figure,
    scientific,
    styled,
)
from .surface import forecast_block
from .view3d.view import html

MOST_VIEWS = 4


def make_blocks(content: ReportContent) -> list[Block]:
    """All figures of the page, in order and numbered from 1."""
    makers = (
        _scene,
        _turned,
        _held_out,
        _explained,
        _light,
        _projections,
        _slices,
        _correlation,
        _history,
        _histograms,
    )
    blocks, number = [], 0
    first = [] if content.moving is None else motion_blocks(content.moving)
    first += [] if content.forecast is None else [forecast_block(content.forecast)]
    drawn = [make(content) for make in makers]
    guessed = [] if content.guess is None else [guess_block(content.guess)]
    if (found := content.rehearsal) is not None and found.found is not None:
        guessed.insert(0, matter_block(found.matter))
    after = makers.index(_slices) + 1
    for block in (*first, *drawn[:after], *guessed, *drawn[after:]):
        number += block.drawn
        blocks.append(replace(block, number=number) if block.drawn else block)
    return blocks


def _scene(content: ReportContent) -> Block:
    heading, material = "Scene and reconstruction", content.surface_material()
    if material is None:
        nothing = f"The reconstruction holds no matter (its {content.quantity.symbol} is zero everywhere)"
        return Block(heading, f"{nothing}, so no surface is drawn.")
    grid, shown = content.reconstruction.grid, content.quantity
    figure = scene_figure(content.reconstruction, content.truth, material)
    size = "\u00a0×\u00a0".join(plain(n * d * 1e6) for n, d in zip(grid.shape[::-1], grid.voxel_size))
    text = (
        f"Surfaces where {shown.symbol} = {shown.text(0.5 * material)}, half of the material's, seen from above. "
        f"The box is the volume, {size}\u00a0µm (x\u00a0×\u00a0y\u00a0×\u00a0z). "
    )
    if not _reaches(content.reconstruction, 0.5 * material):
        text += "No voxel of the reconstruction reaches it. "
    if _reaches(content.reconstruction, -0.5 * material):
        text += "Matter on the other side of the medium's is not drawn here, but in the slices. "
    if content.truth is None:
        text += "a, from the first side; b, turned by 90° about the vertical axis. The truth is not known."
    else:
        voxel = format_length(max(grid.voxel_size))
        text += (
            "a, truth; b, reconstruction; c, the reconstruction coloured by distance from the true surface "
            f"along its own normals: red outside, blue inside of it; colours end at one voxel, {voxel}."
        )
    return drawn_block(heading, text, "The scene and its reconstruction.", figure)


def _reaches(volume: Volume, level: float) -> bool:
    """Whether a voxel's δ is `level`, which has a sign, or more."""
    return bool((volume.delta * np.sign(level) >= abs(level)).any())


def _turned(content: ReportContent) -> Block:
    heading, view = "From any side", content.view
    if view is None:
        return Block(heading, "What would be turned here was not given.")
    first, *others = view.parts
    kinds = {"volume": "a volume", "gaussians": "its Gaussians"}
    shown = kinds.get(view.parts[first].kind, "its surfaces")
    shift = (
        "Values are quantitative: the phase shift is −k∫δ dz"
        if content.delta_told
        else "Absorption is 2k∫β dz = ∫µ dz, the phase is not known"
    )
    text = (
        f"Line integrals and the hologram that they would give, of the {first} by {shown}: drag the first picture, or "
        f"use the arrow keys on it, to turn the object. {shift}, and the "
        "hologram that of an even beam over the distance of the first frame, one wave sample a raster pixel. "
    )
    if others:
        text += f"The {' and the '.join(others)} can be chosen instead, from a volume. "
    return Block(heading, text.strip(), "The object, turned.", live=html(view))


def _held_out(content: ReportContent) -> Block:
    heading, views = "Held-out views", content.held_out
    if views is None:
        return Block(heading, "No view was held out of the fit, so no prediction could be tested.")
    figure = held_out_figure(views, content.pixel_size, MOST_VIEWS)
    count, chosen = len(views.labels), evenly(len(views.labels), MOST_VIEWS).tolist()
    which = f"{len(chosen)} of {count}" if len(chosen) < count else f"all {count}" if count > 1 else "the one"
    (low, high), limit = grey_limits(views.measured), largest(views.predicted - views.measured)
    error = float(np.sqrt(np.mean(np.square(np.subtract(views.predicted, views.measured, dtype=np.float64)))))
    text = (
        "Measured intensity, its prediction from the reconstruction, and their difference, for "
        f"{which} held-out view{'s' * (count > 1)}. "
        f"Measured and predicted share the grey scale {low:.3f} to {high:.3f}, the 0.2 and 99.8 percentiles; "
        f"measured values run from {views.measured.min():.3f} to {views.measured.max():.3f}. "
        f"Colours of differences end at ±{limit:.2g}; their root mean square is {error:.2g}. "
        f"Scores use the range of the training frames, {views.scores.data_range[0]:.3f} to "
        f"{views.scores.data_range[1]:.3f}."
    )
    return drawn_block(heading, text, "Prediction of held-out views.", figure)


def _explained(content: ReportContent) -> Block:
    heading, found = "Are the frames explained?", content.explained
    if found is None:
        return Block(heading, "The training frames were not compared with the reconstruction.")
    figure = explained_figure(found)
    text = (
        f"{in_print(' '.join((found.words, *found.reasons)))} "
        "a, root mean square of what the reconstruction leaves of the training frames, by the period of its Fourier "
        "coefficients, beside the noise, the contrast, and what a residual may have. b, the residual over what it may "
        "have, in each view: colours end at 3."
    )
    return drawn_block(heading, text, "What is left of the training frames.", figure)


def _light(content: ReportContent) -> Block:
    heading, views = "Light", content.lit
    if views is None:
        return Block(heading, "The light of the frames was taken to be even.")
    figure = light_figure(views, content.pixel_size)
    size = [in_percent(float(np.sqrt(np.mean(np.square(image - 1))))) for image in views.light]
    text = (
        f"By the air of the training frames their light is {views.words}. Shown are {len(views.labels)} of them, the "
        f"light that they have beside what the reconstruction predicts (root mean square deviation from one: "
        f"{', '.join(size)}), and what light and reconstruction together leave."
    )
    return drawn_block(heading, text, "Uneven light.", figure)


def _projections(content: ReportContent) -> Block:
    told, maps = content.delta_told, content.projections
    heading = "Projected phase and absorption" if told else "Projected absorption"
    if maps is None:
        return Block(heading, "No line integrals of the reconstruction were given.")
    figure = projections_figure(maps, content.energy_kev, content.pixel_size, told)
    k, name = wavenumber(content.energy_kev), "phase" if told else "absorption"
    text = "Phase φ = −kD with D = ∫δ dz, and absorption 2kB with B = ∫β dz" if told else "Absorption 2k∫β dz = ∫µ dz"
    text += f", at {beam_named(content.energy_kev)[1]}, {' and '.join(maps.labels[:2])}. "
    values = -k * np.asarray(maps.projected_delta[:2]) if told else 2 * k * np.asarray(maps.projected_beta[:2])
    low, high = (scientific(end) for end in _ends(values))
    text += f"The reconstruction's {name} runs from {low} to {high}{' rad' * told}. "
    if maps.true_projected_delta is None:
        text += "The truth is not known."
    else:
        text += "Truth and reconstruction share one colour scale; differences are reconstruction − truth."
    return drawn_block(heading, text, "Line integrals through the object.", figure)


def _ends(values: np.ndarray) -> tuple[float, float]:
    """The least and the greatest of `values`; what single precision cannot tell from 0 beside the other is 0."""
    ends = float(values.min()), float(values.max())
    rounding = float(np.finfo(np.float32).eps) * max(map(abs, ends))
    return tuple(end if abs(end) > rounding else 0.0 for end in ends)  # type: ignore[return-value]


def _slices(content: ReportContent) -> Block:
    truth, delta, shown = content.truth, content.reconstruction.delta, content.quantity
    planes = richest_planes(content.reconstruction if truth is None else truth)
    figure = slices_figure(content.reconstruction, truth, planes, shown, seen=content.seen)
    low, high = (shown.text(end) for end in _ends(delta))
    text = (
        f"{shown.symbol} in the three orthogonal planes that hold most matter. "
        f"Over the whole volume the reconstruction's {shown.symbol} runs from {low} to {high}"
    )
    if truth is None:
        text += ". The truth is not known."
    else:
        low, high = (shown.text(end) for end in _ends(truth.delta))
        text += (
            f", the truth's from {low} to {high}. "
            "Truth and reconstruction share one colour scale; differences are reconstruction − truth."
        )
    return drawn_block("Slices", f"{text} {content.trust}".rstrip(), f"Slices of {shown.symbol}.", figure)


def _correlation(content: ReportContent) -> Block:
    heading, images = "Resolution", None if content.held_out is None else content.held_out.scores
    if images is None and content.volume_scores is None:
        return Block(heading, "Without a held-out view or a truth there is nothing to correlate the result with.")
    figure = correlation_figure(images, content.volume_scores, content.pixel_size)
    text = ""
    if images is not None:
        text += "Fourier ring correlation of predicted with measured held-out views. "
        if content.held_out is not None and content.held_out.pixels is not None and np.ptp(content.held_out.pixels):
            text += "Their pixels differ: frequencies are those of the smallest, with as many periods a pixel. "
    if content.volume_scores is not None:
        crossings = _resolutions(content.volume_scores)
        text += f"Fourier shell correlation of the reconstructed with the true {content.quantity.symbol}, {crossings}. "
    text += (
        "The upper scale is the full period. Both thresholds were made for two halves of one data set "
        "(van Heel & Schatz 2005; Rosenthal & Henderson 2003); against a noise-free truth they are lenient."
    )
    return drawn_block(heading, text, "Correlation in Fourier space.", figure)


def _resolutions(scores: VolumeScores) -> str:
    def said(length: float | None) -> str:
        if length is None:
            return f"not before the sampling limit ({format_length(2 * scores.pitch)})"
        return "from the first shell on" if np.isinf(length) else f"at {format_length(length)}"

    return f"below ½-bit {said(scores.resolution_half_bit)} and below 0.143 {said(scores.resolution_fixed)}"


def _history(content: ReportContent) -> Block:
    heading, figure = "Course of the fit", history_figure(content.history)
    if figure is None:
        return Block(heading, "No course of the fit was recorded.")
    text = (
        "Recorded while fitting, over the steps of the last fit; the loss, and its terms before their weights. They "
        "are means over the pixels of that step: where frames pass to finer pixels or terms join, the loss jumps, and "
        "only losses between two jumps compare."
    )
    return drawn_block(heading, text, "Course of the fit.", figure)


def _histograms(content: ReportContent) -> Block:
    heading, material = "Quantitative values", content.surface_material()
    if material is None:
        return Block(heading, "The reconstruction holds no matter, so there are no values to show.")
    shown = content.quantity
    figure, outside = histogram_figure(content.reconstruction, content.truth, material, shown)
    text = f"The material's {shown.symbol} is {shown.text(material)}; matter is what exceeds half of it. "
    if not content.delta_told:
        text += "The frames show absorption alone: δ, and with it δ\u2060/\u2060β, is not known. "
    elif not _reaches(content.reconstruction, 0.5 * material):
        text += "No voxel of the reconstruction does. "
    elif outside is None:
        text += "β is zero in all matter, so δ\u2060/\u2060β is not defined. "
    else:
        text += f"{in_percent(round(outside, 4))} of the mass lies outside of the range drawn for δ\u2060/\u2060β. "
        if content.truth is not None:
            text += "The truth's δ\u2060/\u2060β is the ratio of its mean δ to its mean β. "
    title = "Distribution of δ\u2060/\u2060β and of δ." if content.delta_told else f"Distribution of {shown.symbol}."
    return drawn_block(heading, text, title, figure)


LARGEST = 3.0
"""Residual over what is allowed at which colours end."""


@styled
def explained_figure(found: Verdict) -> Figure:
    """Residual, noise and contrast by band (left), and the residual over what is allowed by view and band (right)."""
    figure = new_figure(WIDTH, 2.4)
    left, right, bar = figure.subplots(1, 3, width_ratios=[1.1, 1.0, 0.045])
    places = np.arange(found.residual.shape[1])
    rms = {
        name: np.sqrt(np.mean(np.square(getattr(found, name)), axis=0))
        for name in ("contrast", "noise", "allowed", "residual")
    }
    how = {
        "contrast": {"color": FAINT, "ls": (0, (1, 1.5))},
        "noise": {"color": CYCLE[1]},
        "allowed": {"color": INK, "ls": (0, (4, 2)), "lw": 0.8},
        "residual": {"color": RECONSTRUCTION, "marker": "o", "ms": 3.0},
    }
    top = max(float(rms["contrast"].max()), float(rms["residual"].max()), 1e-12)
    for name, values in rms.items():
        left.plot(places, np.where(values > 1e-5 * top, values, np.nan), label=name, **how[name])
    left.set_yscale("log")
    left.set_xticks(places, _labels(found))
    left.tick_params(axis="x", labelrotation=40)
    left.set(xlabel="shortest period (µm)", ylabel="rms of coefficients")
    left.legend(loc="best")
    letter(left, 0, "By period")
    over = found.residual / np.maximum(found.allowed, 1e-30)
    drawn = right.imshow(
        over, cmap="magma", vmin=0, vmax=LARGEST, aspect="auto", interpolation="nearest", origin="lower"
    )
    right.set_xticks(range(over.shape[1]), _labels(found))
    right.tick_params(axis="x", labelrotation=40)
    right.set(xlabel="shortest period (µm)", ylabel="training view")
    right.set_yticks(*_views(len(over)))
    letter(right, 1, "By view")
    colour_bar(figure, drawn, bar, "residual / allowed", "max")
    return figure


def _labels(found: Verdict) -> list[str]:
    return [plain(1e6 * shortest) for shortest in found.periods[:, 0]]


def _views(count: int) -> tuple[list[int], list[str]]:
    """Ticks of views, counted from 1."""
    step = max(1, -(-count // 12))
    places = list(range(0, count, step))
    return places, [str(place + 1) for place in places]


SPREAD_MAP = "magma"
MOST_SPREAD = 0.5
"""Largest standard deviation of values between 0 and 1."""


WITHOUT_EACH = "without one of the views each: where it is large, few frames say what is there"
OF_COPIES = (
    "of the same scene mirrored and turned, for one of two views alone says too little: where it is large, the network "
    "guesses what the frames do not say; where it is small, it may err in all of them alike"
)
"""What guesses the spread is of."""


def guess_block(shown: GuessShown) -> Block:
    """The figure with its caption."""
    text = f"{shown.words} a to c, the occupancy that the network guessed; "
    if shown.spread is None or shown.unsure is None:
        text += "d to f, that of the reconstruction. Where it is guessed, this run did not keep."
    else:
        text += (
            f"d to f, the standard deviation of guesses {OF_COPIES if shown.of_copies else WITHOUT_EACH}. g to i, the "
            "occupancy of the reconstruction. "
            f"{in_percent(shown.unsure)} of its matter lies where guesses differ by more than {UNSURE:g}. There it may "
            "be a guess also after the fit, for other matter might explain the frames as well."
        )
    return drawn_block("What was guessed", text, "A network's guess, and its spread.", guess_figure(shown))


@styled
def guess_figure(shown: GuessShown) -> Figure:
    """Guess, spread and reconstruction in the three planes with most of the guessed matter."""
    planes = richest_planes(Volume(shown.occupancy, shown.occupancy, shown.grid))
    rows = [("Guess", shown.occupancy, DELTA_MAP, 1.0)]
    if shown.spread is not None:
        rows.append(("Spread", shown.spread, SPREAD_MAP, MOST_SPREAD))
    rows.append(("Reconstruction", shown.found, DELTA_MAP, 1.0))
    panels = PanelGrid(len(rows), *plane_sizes(shown.grid), (2,))
    for row, (name, values, colours, most) in enumerate(rows):
        drawn = slice_row(panels.axes[row], values, shown.grid, planes, colours, (0.0, most))
        slice_titles(panels.axes[row], 3 * row, name, shown.grid, planes)
        label = "standard deviation" if name == "Spread" else "occupancy"
        panels.bar(drawn, 2, (row, row), label, "max" if name == "Reconstruction" else "neither")
    return panels.figure
