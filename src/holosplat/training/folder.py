"""A folder of scenes for learning: shards in HDF5, a datasheet, and what they were drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..checks import InputError, require
from ..io.hdf5 import Fields, open_hdf5
from ..io.hdf5_writing import new_hdf5
from ..io.json import read_json, write_json
from ..progress import Advance
from ..tables import from_table, to_table
from ..version import __version__
from .ranges import Ranges
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
        """Make the folder, or take up the one that is there; `InputError` where that holds other scenes."""
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
