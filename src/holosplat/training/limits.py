"""Limits of trained networks in words: untrained conditions, and lowest scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .ranges import Ranges


def limits(ranges: Ranges, views: Sequence[int], scores: Mapping[str, Mapping[str, float]]) -> str:
    """Plain sentences about a network that learnt from scenes of `ranges`, shown in such numbers of `views`.

    scores: the Dice coefficient and the number of scenes of another seed, by the number of views
    """
    return " ".join([_matter(ranges), _views(ranges, views), _noise(ranges), _never(ranges), _worst(scores)])


def _matter(ranges: Ranges) -> str:
    kinds = " and ".join(kind.replace("-", " ") for kind in ranges.kinds)
    full = [ranges.crowded if kind == "crowd" else ranges.filled for kind in ranges.kinds]
    low, high = min(low for low, _ in full), max(high for _, high in full)
    return (
        f"It knows {kinds} alone, {_span(ranges.across)} pixels across, in {100 * low:g} to {100 * high:g} % of the "
        f"room, with δ/β of {_span(ranges.ratio)} and phases of {_span(ranges.phase)} rad, at Fresnel numbers of a "
        f"pixel of {_span(ranges.fresnel)}; of other matter its guesses may be wrong."
    )


def _views(ranges: Ranges, views: Sequence[int]) -> str:
    *counts, most = sorted({min(count, ranges.views) for count in views})
    said = f"{', '.join(map(str, counts))} and {most}" if counts else str(most)
    tilted = f"in a share of {ranges.tilted:g} of them beams were tilted by up to {ranges.tilt:g}°"
    return f"It saw scenes in {said} views; {tilted if ranges.tilted else 'all beams had one axis'}."


def _noise(ranges: Ranges) -> str:
    if ranges.noiseless == 1:
        return "It never saw noise."
    return f"It never saw noise of more than {ranges.noise[1]:g} of the phase of a body."


def _never(ranges: Ranges) -> str:
    """What no scene of the ranges has."""
    missing = {
        "two materials of one δ/β in a body": "filled-capsules" not in ranges.kinds,
        "continuous matter": "soft-cells" not in ranges.kinds,
        "a medium that absorbs more than the bodies": ranges.medium == 0,
        "uneven light": ranges.uneven[1] == 0,
        "misaligned views": ranges.misaligned_px[1] == 0,
        "materials of different δ/β": True,
        "beams that are not parallel": True,
    }
    *first, last = [name for name, is_missing in missing.items() if is_missing]
    return f"Nor did it see {', '.join(first)} or {last}."


def _worst(scores: Mapping[str, Mapping[str, float]]) -> str:
    views = min(scores, key=lambda count: scores[count]["dice"])
    worst = scores[views]
    return (
        f"It is worst in {views} views: on {worst['scenes']:.0f} scenes of another seed the mean Dice coefficient is "
        f"{worst['dice']:.2f}."
    )


def _span(pair: tuple[float, float]) -> str:
    return f"{pair[0]:g} to {pair[1]:g}"
