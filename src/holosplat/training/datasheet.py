"""The datasheet of a dataset (Gebru et al. 2021, Commun. ACM 64(12), 86): what it is, in words."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields

from ..io.atomic import atomic_path
from ..version import __version__
from .folder import SHARD, Dataset
from .ranges import Ranges
from .sample import Sample

NAME = "datasheet.md"
TEXT = """# Simulated scenes for learning

**What.** {count} scenes of {kinds}, each imaged in {views} noisy frames for training and {held_out} noise-free frames
that are held out, of {rows} × {columns} pixels, in parallel beams. Made to train networks that guess matter from few
X-ray phase-contrast views. No measured data, no persons, nothing confidential.

**Made by** holosplat {version}: `holosplat dataset` with seed {seed}. The scene of a seed and a number is always the
same, so that the files can be made again from `dataset.json`. Bodies are closed meshes or continuous matter; waves are
propagated on a raster at least four times finer than the pixels and integrated over them; counts are Poisson.
`thickness` is no measurement: it is what nonlinear phase retrieval of each frame by itself finds, the true δ/β given.

**Not in it.** Absorption edges, materials of different δ/β in one scene, scatter, drifting light and defective pixels;
a medium, uneven light and misaligned views only where the ranges below say so. Two materials are in filled capsules
alone. Networks trained on it know the bodies that are in it.

**Licence.** Made by you with BSD-3-Clause software, which claims nothing in its output.

## Files

`scenes-NNNNNN.h5` holds {shard} scenes from number NNNNNN on (HDF5, deflated, with checksums); the first axis of every
array counts them. Coordinates, signs and pixel centres are those of holosplat's `docs/conventions.md`.

{arrays}

## Ranges

| range | drawn from | meaning |
| --- | --- | --- |
{ranges}
"""


def write_datasheet(dataset: Dataset) -> None:
    """Write the datasheet of `dataset` into its folder."""
    ranges = dataset.ranges
    text = TEXT.format(
        count=dataset.count,
        kinds=", ".join(ranges.kinds),
        views=ranges.views,
        held_out=ranges.held_out,
        rows=ranges.rows,
        columns=ranges.columns,
        version=__version__,
        seed=dataset.seed,
        shard=SHARD,
        arrays=_arrays(),
        ranges="\n".join(_rows(ranges)),
    )
    with atomic_path(dataset.folder / NAME) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _arrays() -> str:
    """The arrays of a sample, as its docstring has them, a bullet each."""
    said = inspect.cleandoc(Sample.__doc__ or "").split("\n\n", 1)[1].replace("\n    ", " ")
    return re.sub(r"^", "- ", said, flags=re.MULTILINE)


def _rows(ranges: Ranges) -> list[str]:
    """A row of the table for each field, with what stands below it in the source."""
    meanings = re.findall(r'^    (\w+): .*\n    """((?:.|\n)*?)"""', inspect.getsource(Ranges), flags=re.MULTILINE)
    said = {name: " ".join(text.split()) for name, text in meanings}
    return [f"| {each.name} | {_shown(getattr(ranges, each.name))} | {said[each.name]} |" for each in fields(ranges)]


def _shown(value: object) -> str:
    if isinstance(value, tuple) and isinstance(value[0], float):
        return f"{value[0]:g} to {value[1]:g}"
    return ", ".join(value) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else str(value)
