"""Compact files of several objects of a series, which share what does not change (docs/export.md, "Compact").

The first object stands as in a compact file. Of each later one a tensor is left out where it is the first's, stored as
the difference from the first's whole numbers where that takes less, and else by itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
import torch

from ..checks import InputError, as_written, require
from ..ranges import require_plausible
from ..representations import KINDS, GaussianCloud, Stored
from .compact import SERIES, Steps, Whole, get_whole, order_of, ordered, put_whole, size_of
from .hdf5 import Fields, open_hdf5
from .hdf5_writing import new_hdf5
from .objects import joined, parted, sound

MOST_OBJECTS = 100_000
"""Objects that a file may hold."""


def write_series(path: Path, objects: Mapping[str, Stored], steps: Steps) -> None:
    """Write objects by their names, in this order, into one compact file, as near as `steps` say.

    Errors: `InputError` for none, or too many.
    """
    require(0 < len(objects) <= MOST_OBJECTS, f"a series needs 1 to {MOST_OBJECTS} objects, but has {len(objects)}.")
    first, order, text = dict[str, Whole](), None, ""
    with new_hdf5(path) as file:
        file.attrs.update(format=SERIES, count=len(objects))
        for number, (name, obj) in enumerate(objects.items()):
            group = file.create_group(f"{number:06d}")
            own = order_of(obj)
            if number == 0:
                order = own
            orders = [own] if number == 0 or not _alike(obj, order) else [own, order]
            whole, plain = min(
                (_whole(ordered(obj, o), first, steps) for o in orders), key=lambda f: _cost(f[0], first)
            )
            state = json.dumps(plain)
            group.attrs.update(name=name, kind=obj.kind)
            if number == 0 or state != text:
                group.attrs["state"] = state
            _put(group, whole, first)
            if number == 0:
                first, text = whole, state


def read_series(path: Path) -> dict[str, Stored]:
    """The objects of a file of `write_series` by their names, in their order; `InputError` for any other file."""
    with open_hdf5(path) as file:
        form = str(file.attrs.get("format", ""))
        require(form == SERIES, f"{path} must be a {SERIES!r} file, but its format is {form[:40]!r}.")
        fields, found = Fields(path, file), dict[str, Stored]()
        first, state = dict[str, Whole](), ""
        for number, key in enumerate(sorted(file)):
            group = file[key]
            if not isinstance(group, h5py.Group):
                raise InputError(f"{fields.label(key)} must be an object, but it is none.")
            whole = _get(group, fields, first)
            with as_written(path, "a whole series"):
                text = str(group.attrs.get("state", state))
                plain = json.loads(text)
                require_plausible(plain)
                tensors = {n: torch.from_numpy(sound(fields.label(f"{key}/{n}"), w.values())) for n, w in whole.items()}
                kind = KINDS[str(group.attrs["kind"])]
                found[str(group.attrs["name"])] = kind.from_state(joined(tensors, plain))
            if number == 0:
                first, state = whole, text
    require(len(found) > 0, f"{path} must hold objects, but it holds none.")
    return found


def _alike(obj: Stored, order: torch.Tensor | None) -> bool:
    """Whether the parts of an object may be those of the first, in whose order they can be stored."""
    return isinstance(obj, GaussianCloud) and order is not None and len(obj) == len(order)


def _whole(obj: Stored, first: Mapping[str, Whole], steps: Steps) -> tuple[dict[str, Whole], dict]:
    """The tensors of an object in steps, those of the first where it has any, and its plain values."""
    tensors, plain = parted(obj.state())
    step = {name: whole.step for name, whole in first.items()}
    return {name: Whole.of(name, t, steps, step.get(name)) for name, t in tensors.items()}, plain


def _cost(whole: Mapping[str, Whole], first: Mapping[str, Whole]) -> int:
    """Bytes that an object takes beside the first, about."""
    return sum(_least(w, first.get(name))[1] for name, w in whole.items())


def _least(whole: Whole, first: Whole | None) -> tuple[str, int]:
    """How a tensor takes the fewest bytes: `same`, `change` (from the first) or `own`, and about how many."""
    if not whole.counted:
        same = first is not None and np.array_equal(whole.numbers, first.numbers) and whole.dtype == first.dtype
        return ("same", 0) if same else ("own", whole.numbers.nbytes)
    own = min(size_of(whole.numbers), size_of(np.diff(whole.numbers, axis=-1, prepend=0)))
    if first is None or first.numbers.shape != whole.numbers.shape or first.step != whole.step:
        return "own", own
    change = whole.numbers - first.numbers
    if not change.any():
        return "same", 0
    size = min(size_of(change), size_of(np.diff(change, axis=-1, prepend=0)))
    return ("change", size) if size < own else ("own", own)


def _put(group: h5py.Group, whole: Mapping[str, Whole], first: Mapping[str, Whole]) -> None:
    same = []
    for name, w in whole.items():
        how, _ = _least(w, first.get(name))
        if how == "same":
            same.append(name)
            continue
        change = Whole(w.numbers - first[name].numbers, w.step, w.dtype) if how == "change" else w
        put_whole(group, name, change).attrs["from_first"] = how == "change"
    group.attrs["as_first"] = json.dumps(same)


def _get(group: h5py.Group, fields: Fields, first: Mapping[str, Whole]) -> dict[str, Whole]:
    """The tensors of an object; `InputError` where it refers to what the first has not."""
    own, label = dict[str, h5py.Dataset](), fields.label(str(group.name).strip("/"))
    group.visititems(lambda name, item: own.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    with as_written(fields.path, "a whole series"):
        same = [str(name) for name in json.loads(str(group.attrs["as_first"]))]
    found = {name: _of_first(first, name, f"{label}/{name}") for name in same}
    for name, dataset in own.items():
        where = f"{label}/{name}"
        found[name] = change = get_whole(dataset, where)
        if bool(dataset.attrs.get("from_first", False)):
            begun = _of_first(first, name, where).numbers
            require(begun.shape == change.numbers.shape, f"{where} must fit the first object's, but it does not.")
            found[name] = Whole(begun + change.numbers, change.step, change.dtype)
    return found


def _of_first(first: Mapping[str, Whole], name: str, where: str) -> Whole:
    if name not in first:
        raise InputError(f"{where} must be in the first object, to which it refers, but it is not.")
    return first[name]


def names_of(paths: Sequence[Path]) -> list[str]:
    """Names of runs in a series: those of their folders, as much of the path as tells them apart."""
    parts = [path.resolve().parts for path in paths]
    for depth in range(1, max(map(len, parts), default=0) + 1):
        found = ["/".join(p[-depth:]) for p in parts]
        if len(set(found)) == len(found):
            return found
    raise InputError("the runs of a series must be different folders, but one is named twice.")
