"""JSON tables with clear messages, for the readers of folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, finite, require, shaped
from ..tables import shown
from .json import read_json


@dataclass(frozen=True)
class Table:
    """The entries `values` of the JSON file `path`, below `where` in it; messages name the file and the entry."""

    path: Path
    values: dict[str, Any]
    where: str = ""

    @classmethod
    def read(cls, path: Path) -> Table:
        """The table that a file holds."""
        require(path.is_file(), f"{path} must be a JSON file, but there is no such file; check the folder.")
        return cls(path, read_json(path))

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def label(self, name: str) -> str:
        """How messages call the entry `name`."""
        return f"{self.path}: {self.where}{name}"

    def need(self, name: str) -> Any:
        """The entry `name`; `InputError` where there is none."""
        if name not in self.values:
            raise InputError(f"{self.label(name)} must be there, but it is missing; add it.")
        return self.values[name]

    def number(self, name: str) -> float:
        """A finite number."""
        return float(self.numbers(name, ()))

    def numbers(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite numbers, float64, nested as `shape` says."""
        value = self.need(name)
        try:
            array = np.array(value)
        except ValueError:  # rows of unequal length
            array = np.array("uneven rows")
        if array.dtype.kind not in "iuf":
            raise InputError(f"{self.label(name)} must hold numbers, but it is {shown(value)}.")
        return finite(self.label(name), shaped(self.label(name), array.astype(np.float64), shape))

    def count(self, name: str) -> int:
        """A whole number, not negative."""
        return self.counts(name, ())[0]

    def counts(self, name: str, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Whole numbers, none of them negative."""
        numbers = self.numbers(name, shape).reshape(-1)
        whole = bool((numbers == np.floor(numbers)).all() and (numbers >= 0).all())
        require(whole, f"{self.label(name)} must hold whole numbers from 0 on, but it is {shown(self.values[name])}.")
        return tuple(int(n) for n in numbers)

    def text(self, name: str) -> str:
        """A text."""
        value = self.need(name)
        require(isinstance(value, str), f"{self.label(name)} must be a text, but it is {shown(value)}.")
        return value

    def require_format(self, known: str) -> None:
        """`InputError` unless the entry `format` is the one that is `known`."""
        found = self.text("format")
        require(found == known, f"{self.label('format')} must be {known!r}, but it is {found!r}; write it anew.")

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self.need(name)
        require(isinstance(value, bool), f"{self.label(name)} must be true or false, but it is {shown(value)}.")
        return value

    def table(self, name: str) -> Table:
        """A table within the table."""
        value = self.need(name)
        require(isinstance(value, dict), f"{self.label(name)} must be a table, but it is {shown(value)}.")
        return Table(self.path, value, f"{self.where}{name}.")

    def tables(self, name: str) -> list[Table]:
        """A list of tables."""
        value = self.need(name)
        good = isinstance(value, list) and all(isinstance(entry, dict) for entry in value)
        require(good, f"{self.label(name)} must be a list of tables, but it is {shown(value)}.")
        return [Table(self.path, entry, f"{self.where}{name}[{n}].") for n, entry in enumerate(value)]

    def texts(self, name: str) -> dict[str, str]:
        """A table of texts; empty where there is none."""
        found = self.table(name) if name in self else Table(self.path, {})
        return {key: found.text(key) for key in found.values}

    def file(self, name: str, suffix: str = "") -> Path:
        """A file below the folder of this one, whose path (before `suffix`) is the entry `name`."""
        folder = self.path.parent.resolve()
        nameable = "\0" not in self.text(name)
        require(nameable, f"{self.label(name)} must be the name of a file, but it is {shown(self.values[name])}.")
        found = (folder / (self.text(name) + suffix)).resolve()
        inside = found.is_relative_to(folder)
        require(inside, f"{self.label(name)} must name a file in the folder, but it is {shown(self.values[name])}.")
        require(found.is_file(), f"{self.label(name)} names {self.text(name) + suffix}, but there is no such file.")
        return found
