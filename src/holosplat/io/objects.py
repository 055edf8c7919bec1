"""Objects of every kind as HDF5 files: tensors as datasets, everything else as one JSON attribute.

Compact files of several objects of a series share what does not change (docs/export.md, "Compact"). The first object
stands as in a compact file. Of each later one a tensor is left out where it is the first's, stored as the difference
from the first's whole numbers where that takes less, and else by itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from ..checks import InputError, as_written, finite, positive, require
from ..matter import Matter
from ..ranges import LARGEST, require_plausible
from ..representations import KINDS, GaussianCloud, Stored
from ..representations.gaussians import PARAMETERS
from . import compact
from .compact import SERIES, Steps, Whole, get_whole, order_of, ordered, put_whole, size_of
from .hdf5 import Fields, attribute_numbers, new_hdf5, open_hdf5, put

FORMAT = "holosplat object 1"
MOST_TEXT = 60_000
"""Characters of the attribute, at most: HDF5 holds 64 kB of them."""


def write_object(path: Path, obj: Stored, marks: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write an Object: the attributes `format`, `kind` and `state` (JSON), and a dataset for each of its tensors.

    marks: further attributes."""
    with _new_object(path, obj, FORMAT, marks) as (file, tensors):
        for name, tensor in tensors.items():
            put(file, name, tensor.detach().cpu().numpy())


def write_compact(path: Path, obj: Stored, steps: Steps) -> None:
    """Write an Object in few bytes, as near as `steps` say (`put_whole`); `read_object` reads it."""
    with _new_object(path, ordered(obj, order_of(obj)), compact.FORMAT) as (file, tensors):
        for name, tensor in tensors.items():
            put_whole(file, name, Whole.of(name, tensor, steps))


@contextmanager
def _new_object(
    path: Path, obj: Stored, form: str, marks: Mapping[str, str] = MappingProxyType({})
) -> Iterator[tuple[h5py.File, dict[str, Tensor]]]:
    """A new file with all of an Object but its tensors, and these."""
    tensors, plain = parted(obj.state())
    text = json.dumps(plain)
    assert len(text) < MOST_TEXT
    with new_hdf5(path) as file:
        file.attrs.update(marks, format=form, kind=obj.kind, state=text)
        yield file, tensors


def read_object(path: Path) -> Stored:
    """The Object that `write_object` or `write_compact` wrote, or the Gaussians of a file of version 0.1; `InputError`
    for any other."""
    with open_hdf5(path) as file:
        form = str(file.attrs.get("format", ""))
        require(
            form != compact.SERIES,
            f"{path} must hold one object, but it holds a series of them; choose one with holosplat.io.objects.",
        )
        if form == GAUSSIANS_FORMAT:
            return read_gaussians(path)
        kind = KINDS.get(str(file.attrs.get("kind", "")))
        if form not in (FORMAT, compact.FORMAT) or kind is None:
            raise InputError(
                f"{path} must be a {FORMAT!r} file of the kinds {', '.join(KINDS)}, but its format is {form[:40]!r}."
            )
        fields, names = Fields(path, file), list[str]()
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        arrays = dict[str, np.ndarray]()
        for name in names:
            dataset, label = fields.dataset(name), fields.label(name)
            few = form == compact.FORMAT
            arrays[name] = sound(label, get_whole(dataset, label).values() if few else np.asarray(dataset[()]))
        with as_written(path, "a whole object"):
            plain = json.loads(str(file.attrs["state"]))
            require_plausible(plain)
            return kind.from_state(joined({name: torch.from_numpy(a) for name, a in arrays.items()}, plain))


def sound(label: str, array: np.ndarray) -> np.ndarray:
    """`array`, if it holds numbers that an Object may have."""
    require(array.dtype.kind in "iufb", f"{label} must hold numbers, but it does not.")
    finite(label, array)
    most = float(np.abs(array).max(initial=0))
    largest = 1000 * LARGEST  # of coordinates in pixels and of amplitudes, which no setting is
    require(most <= largest, f"{label} must hold numbers of at most {largest:g}, but one is {most:g}.")
    return array


def parted(state: Mapping[str, Any], prefix: str = "") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors by their path, and what is left."""
    tensors, plain = dict[str, Tensor](), dict[str, Any]()
    for name, value in state.items():
        if isinstance(value, Tensor):
            tensors[prefix + name] = value
        elif isinstance(value, Mapping):
            inner, plain[name] = parted(value, f"{prefix}{name}/")
            tensors |= inner
        else:
            plain[name] = value
    return tensors, plain


def joined(tensors: Mapping[str, Tensor], plain: Mapping[str, Any]) -> dict[str, Any]:
    """The state of which `parted` made two."""
    state = json.loads(json.dumps(plain))
    for path, tensor in tensors.items():
        *groups, name = path.split("/")
        place = state
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = tensor
    return state


GAUSSIANS_FORMAT = "holosplat Gaussians 1"


def read_gaussians(path: Path) -> GaussianCloud:
    """The cloud that version 0.1 wrote; `InputError` if the file is damaged or no such file."""
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        arrays = {fields.label(name): fields.numbers(fields.need(name)) for name in PARAMETERS}
        unit, delta, beta = (
            float(attribute_numbers(f"{path}: @{name}", file.attrs.get(name), (1,))[0])
            for name in ("unit_length", "delta", "beta")
        )
        other = file.attrs.get("second")
        second = None if other is None else attribute_numbers(f"{path}: @second", other, (2,))
    tensors = [torch.from_numpy(finite(label, array).astype(np.float32)) for label, array in arrays.items()]
    if second is not None:
        matter = Matter.several((delta, beta), (float(second[0]), float(second[1])))
    else:
        matter = Matter.one(delta, beta) if tensors[3].shape[1:] == (1,) else Matter.free(delta, beta)
    try:
        return GaussianCloud(tensors, positive("unit_length", unit, "metres"), matter)
    except InputError as error:
        raise InputError(f"{path} must hold Gaussians, but it does not: {error}") from error


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
