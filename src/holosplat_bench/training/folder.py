"""A dataset folder of scenes (shards in HDF5, a datasheet), and scenes as a `torch` dataset."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from holosplat.checks import InputError, require
from holosplat.io.atomic import atomic_path, read_json, write_json
from holosplat.io.hdf5 import Fields, new_hdf5, open_hdf5
from holosplat.io.provenance import command_now, take_up
from holosplat.progress import Advance
from holosplat.tables import from_table, to_table
from holosplat.version import __version__

from .options import Ranges
from .sample import Sample, sample_of

SHARD = 25
"""Scenes of a file: some megabytes, a minute's work."""
NAME = "dataset.json"
VERSION = 1
"""Of the layout."""


@dataclass(frozen=True)
class Dataset:
    """Scenes 0 … count - 1 of `seed`, drawn from `ranges`, in `folder`."""

    folder: Path
    ranges: Ranges
    seed: int
    count: int

    @classmethod
    def read(cls, folder: Path) -> Dataset:
        """The dataset in `folder`; `InputError` where there is none, or of another version."""
        path = folder / NAME
        require(path.is_file(), f"{folder} must be a folder that holosplat dataset made, but it has no {NAME}.")
        said = read_json(path)
        require(
            said.get("version") == VERSION,
            f"{path}: version must be {VERSION}, but it is {said.get('version')!r}; make the dataset anew.",
        )
        return cls(folder, from_table(Ranges, said["ranges"]), int(said["seed"]), int(said["count"]))

    def begin(self) -> None:
        """Make the folder, or continue an existing one; `InputError` where that holds other scenes."""
        path = self.folder / NAME
        if path.is_file():
            there = Dataset.read(self.folder)
            require(
                replace(there, count=self.count) == self,
                f"{self.folder} holds scenes of other ranges or another seed; choose another --out.",
            )
        elif self.folder.exists() and any(self.folder.iterdir()):
            raise InputError(f"{self.folder} must be new, empty, or a dataset, but it is none of these.")
        self.folder.mkdir(parents=True, exist_ok=True)
        said = {"version": VERSION, "seed": self.seed, "count": self.count, "holosplat": __version__}
        write_json(path, said | {"ranges": to_table(self.ranges)})

    def shards(self) -> Sequence[range]:
        """The scenes of each file."""
        return [range(first, min(first + SHARD, self.count)) for first in range(0, self.count, SHARD)]

    def file(self, shard: range) -> Path:
        """Path of the scenes of `shard`."""
        return self.folder / f"scenes-{shard.start:06d}.h5"

    def missing(self) -> list[range]:
        """Shards that are still to be made; one that has fewer scenes than asked for now counts as missing."""
        return [shard for shard in self.shards() if not self._whole(shard)]

    def _whole(self, shard: range) -> bool:
        if not self.file(shard).is_file():
            return False
        with open_hdf5(self.file(shard)) as file:
            return len(Fields(self.file(shard), file).dataset(Sample.names()[0])) >= len(shard)

    def require_whole(self) -> None:
        """`InputError` unless all scenes are there."""
        missing = self.missing()
        require(
            not missing,
            f"{self.folder} lacks {len(missing)} of {len(self.shards())} files; run holosplat dataset again, with the "
            "same options.",
        )

    def make(self, shard: range, on_progress: Advance = lambda fraction: None) -> None:
        """Simulate the scenes of `shard` and write their file, whole or not at all."""
        samples = []
        for done, index in enumerate(shard):
            samples.append(sample_of(self.ranges, self.seed, index))
            on_progress((done + 1) / len(shard))
        with new_hdf5(self.file(shard)) as file:
            file.attrs["first"] = shard.start
            for name in Sample.names():
                values = np.stack([getattr(each, name) for each in samples])
                file.create_dataset(
                    name, data=values, chunks=(1, *values.shape[1:]), compression="gzip", shuffle=True, fletcher32=True
                )

    def sample(self, index: int) -> Sample:
        """Scene number `index`; `InputError` where its file is missing or damaged."""
        shard = range(index - index % SHARD, index - index % SHARD + 1)
        path = self.file(shard)
        require(path.is_file(), f"{path} is missing; run holosplat dataset with the same options again.")
        with open_hdf5(path) as file:
            fields = Fields(path, file)
            return Sample(**{name: np.asarray(fields.dataset(name)[index % SHARD]) for name in Sample.names()})


def make_dataset(dataset: Dataset, jobs: int, on_progress: Advance) -> int:
    """Simulate what `dataset` lacks and write its datasheet; the number of files that were made.

    What is interrupted keeps its whole files. Errors: those of `Dataset.begin`.
    """
    dataset.begin()
    write_datasheet(dataset)
    missing, whole = dataset.missing(), len(dataset.shards())
    done = whole - len(missing)
    if jobs == 1:
        for shard in missing:
            before = done
            dataset.make(shard, lambda part, before=before: on_progress((before + part) / whole))
            done += 1
        return len(missing)
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), take_up, (command_now(),))
    try:
        for future in as_completed([pool.submit(_made, dataset, shard) for shard in missing]):
            future.result()
            done += 1
            on_progress(done / whole)
    finally:
        pool.shutdown(cancel_futures=True)
    return len(missing)


def _made(dataset: Dataset, shard: range) -> None:
    """In a process of its own, which shares the machine."""
    torch.set_num_threads(1)
    dataset.make(shard)


DATASHEET = "datasheet.md"
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
    with atomic_path(dataset.folder / DATASHEET) as temporary:
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


Tensors = dict[str, Tensor]
"""The arrays of a `Sample` by their names."""
ENDLESS = 2**31
"""Scenes of a seed: nobody draws so many."""


class Scenes(TorchDataset[Any]):
    """Scenes 0 … count - 1 of `seed`, drawn from `ranges` and simulated one by one, without a folder.

    A scene is that of its number and seed whatever else is asked for, in whatever order and process, so that a
    `DataLoader` may shuffle them and simulate in several workers. An item is a dictionary of tensors, the arrays of
    `Sample` by name and shape, or what `shown` makes of the sample. Errors: `IndexError` beyond the last scene.
    """

    def __init__(
        self, ranges: Ranges, seed: int = 0, count: int = ENDLESS, shown: Callable[[Sample], Any] | None = None
    ) -> None:
        require(1 <= count <= ENDLESS, f"count must lie between 1 and {ENDLESS}, but it is {count}; correct it.")
        self.ranges, self.seed, self.count, self.shown = ranges, seed, count, shown

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Any:
        number = int(index) + self.count * (index < 0)
        if not 0 <= number < self.count:
            raise IndexError(f"scenes are numbered from 0 to {self.count - 1}, but {index} is asked for")
        sample = sample_of(self.ranges, self.seed, number)
        return tensors_of(sample) if self.shown is None else self.shown(sample)


def tensors_of(sample: Sample) -> Tensors:
    """The arrays of `sample` as tensors of their own."""
    return {name: torch.from_numpy(np.array(getattr(sample, name))) for name in Sample.names()}
