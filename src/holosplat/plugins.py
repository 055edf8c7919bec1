"""Tables that packages beside this one add to, by the entry points of their distributions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

Entry = TypeVar("Entry")


class Extended(Mapping[str, Entry]):
    """The table `own`, and behind it what the entry points of `group` name.

    Entry points are looked up when a name is asked for that is not in `own`, or all names are; what one names is
    imported when it is asked for itself. A name of `own` stays what it is.
    """

    def __init__(self, own: Mapping[str, Entry], group: str) -> None:
        self.own, self._group = own, group
        self._found: dict[str, EntryPoint] | None = None

    def __getitem__(self, name: str) -> Entry:
        return self.own[name] if name in self.own else self._added()[name].load()

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in self._added()

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from (name for name in self._added() if name not in self.own)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _added(self) -> dict[str, EntryPoint]:
        if self._found is None:
            self._found = {one.name: one for one in entry_points(group=self._group)}
        return self._found
