"""Objects of every kind as HDF5 files: tensors as datasets, everything else as one JSON attribute.

Compact files (docs/export.md, "Compact") hold whole numbers of a step, differences from row to row, compressed. What a
tensor's numbers mean decides how fine they must be: places to a share of a pixel, logarithms of deviations to a share
of the deviation, quaternions to an angle, values to a share of their range. Gaussians stand in the order of a curve
that fills space (Morton 1966), so that neighbours in the file are neighbours in space.

Compact files of several objects share what does not change. The first object stands as in a compact file. Of each later
one a tensor is left out where it is the first's, or stored as the difference from it where that takes less.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from ..checks import InputError, as_written, finite, in_range, positive, require
from ..matter import Matter
from ..ranges import LARGEST, checked_dataclass, require_plausible
from ..representations import KINDS, GaussianCloud, Stored
from ..representations.gaussians import PARAMETERS
from .hdf5 import Fields, attribute_numbers, new_hdf5, open_hdf5, put

FORMAT = "holosplat object 1"
MOST_TEXT = 60_000
"""Characters of the attribute, at most: HDF5 holds 64 kB of them."""
COMPACT = "holosplat compact 1"
SERIES = "holosplat compact series 1"
COMPRESSED = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True}
"""How HDF5 stores the whole numbers: filters that each of its readers has."""
FINEST, COARSEST = 1e-4, 1.0
"""Steps of places [pixels] that may be asked for."""
LEVELS = 2000
"""Steps in the range of voxel values."""


@checked_dataclass
class Steps:
    """The steps of what is stored.

    place: of centres, vertices and the coefficients of paths [pixels]
    log_scale: of the logarithms of deviations, in shares of the deviation
    turn: of the components of quaternions, which are half angles [rad]
    raw: of amplitudes before softplus, in shares of one, and of voxel values in 1/(20 `LEVELS`) of their range
    """

    place: float = 1 / 32
    log_scale: float = 0.03
    turn: float = 0.015
    raw: float = 0.02

    def of(self, name: str, values: np.ndarray) -> float | None:
        """The step of the tensor called `name`; None for one that is kept as it is."""
        last = name.rpartition("/")[2]
        if last in ("centres", "vertices", "coefficients"):
            return self.place
        if last == "values":
            return self.raw * 50 * float(np.ptp(values) or 1.0) / LEVELS
        return {"log_scales": self.log_scale, "quaternions": self.turn, "raw_amplitudes": self.raw}.get(last)


def steps_of(place_px: float) -> Steps:
    """The steps that go with one of places [pixels]; `InputError` outside of `FINEST` to `COARSEST`."""
    in_range("step", place_px, FINEST, COARSEST, unit="pixels")
    return Steps(*(place_px / Steps.place * value for value in vars(Steps()).values()))


def order_of(obj: Stored) -> Tensor | None:
    """The order [N] of the parts of an object that compresses well; None if it has no parts to be put in order."""
    if not isinstance(obj, GaussianCloud) or len(obj) == 0:
        return None
    places = obj.centres.detach().cpu().numpy()
    low, high = places.min(axis=0), places.max(axis=0)
    cells = (1023 * (places - low) / np.maximum(high - low, 1e-30)).astype(np.int64)
    code = np.zeros(len(places), dtype=np.int64)  # along Morton's curve through 1024 cells an axis of their box
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.from_numpy(np.argsort(code, kind="stable"))


def ordered(obj: Stored, order: Tensor | None) -> Stored:
    """The object with its parts in `order`; their sum does not depend on it."""
    if not isinstance(obj, GaussianCloud) or order is None:
        return obj
    parameters = {name: p.detach().cpu()[order] for name, p in obj.parameters().items()}
    q = torch.nn.functional.normalize(parameters["quaternions"], dim=1)
    parameters["quaternions"] = torch.where(q[:, :1] < 0, -q, q)  # q and -q are one rotation
    return obj.replaced(parameters.values())


@dataclass(frozen=True)
class Whole:
    """A tensor as whole numbers of a `step`, last axis first (0: `numbers` are its values), of the type `dtype`."""

    numbers: np.ndarray
    step: float
    dtype: np.dtype

    @classmethod
    def of(cls, name: str, tensor: Tensor, steps: Steps, step: float | None = None) -> Whole:
        """The tensor called `name`; `step` goes before what `steps` say."""
        values = tensor.detach().cpu().numpy()
        step = (steps.of(name, values) or 0.0) if step is None else step
        numbers = np.rint(values / step).astype(np.int64) if step else values
        return cls(np.moveaxis(numbers, -1, 0) if numbers.ndim > 0 else numbers, step, values.dtype)

    def values(self) -> np.ndarray:
        """The tensor, as near as it was stored."""
        numbers = np.moveaxis(self.numbers, 0, -1) if self.numbers.ndim > 0 else self.numbers
        return np.ascontiguousarray(self.step * numbers if self.step else numbers, dtype=self.dtype)

    @property
    def counted(self) -> bool:
        """Whether there are whole numbers in it that may be stored as differences."""
        return self.numbers.dtype.kind in "iu" and self.numbers.ndim > 0


def put_whole(group: h5py.Group, name: str, whole: Whole) -> h5py.Dataset:
    """Store a tensor, last axis first, with the attributes `step` (0: its values), `differences` and `dtype`."""
    numbers, differences = whole.numbers, False
    if whole.counted:
        apart = np.diff(numbers, axis=-1, prepend=0)
        differences = size_of(apart) < size_of(numbers)
        numbers = _small(apart if differences else numbers)
    dataset = group.create_dataset(name, data=numbers, **(COMPRESSED if numbers.size and numbers.ndim else {}))
    dataset.attrs.update(step=whole.step, differences=differences, dtype=str(whole.dtype))
    return dataset


def get_whole(dataset: h5py.Dataset, label: str) -> Whole:
    """What `put_whole` stored; `InputError` where its attributes say nothing sensible."""
    with as_written(label, "a tensor with its step, type and differences"):
        step, dtype = float(np.asarray(dataset.attrs["step"])), np.dtype(str(dataset.attrs["dtype"]))
        differences = bool(dataset.attrs["differences"])
    numbers = np.asarray(dataset[()])
    if not (np.isfinite(step) and step >= 0 and dtype.kind in "iufb"):
        raise InputError(f"{label} must have a step of zero or more and a type of numbers, but has {step:g}, {dtype}.")
    if differences and numbers.ndim > 0:
        numbers = np.cumsum(numbers, axis=-1, dtype=np.int64)
    return Whole(numbers, step, dtype)


def _small(whole: np.ndarray) -> np.ndarray:
    """Whole numbers in the smallest signed type that holds them."""
    largest = int(np.abs(whole).max(initial=0))
    return whole.astype(next(t for t in (np.int8, np.int16, np.int32, np.int64) if largest <= np.iinfo(t).max))


def size_of(whole: np.ndarray) -> int:
    """Bytes that whole numbers take compressed, about: their bytes of each significance by themselves."""
    small = np.ascontiguousarray(_small(whole))
    return len(zlib.compress(small.view(np.uint8).reshape(-1, small.itemsize).T.tobytes(), 6))


def write_object(path: Path, obj: Stored, marks: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write an Object: the attributes `format`, `kind`, `state` (JSON) and `marks`, and a dataset for each tensor."""
    with _new_object(path, obj, FORMAT, marks) as (file, tensors):
        for name, tensor in tensors.items():
            put(file, name, tensor.detach().cpu().numpy())


def write_compact(path: Path, obj: Stored, steps: Steps) -> None:
    """Write an Object in few bytes, as near as `steps` say (`put_whole`); `read_object` reads it."""
    with _new_object(path, ordered(obj, order_of(obj)), COMPACT) as (file, tensors):
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
    """The Object in a file of ours, also of Gaussians of version 0.1; `InputError` for any other file."""
    with open_hdf5(path) as file:
        form = str(file.attrs.get("format", ""))
        require(
            form != SERIES,
            f"{path} must hold one object, but it holds a series of them; choose one with holosplat.io.objects.",
        )
        if form == GAUSSIANS_FORMAT:
            return read_gaussians(path)
        kind = str(file.attrs.get("kind", ""))
        if form not in (FORMAT, COMPACT) or kind not in KINDS:
            raise InputError(
                f"{path} must be a {FORMAT!r} file of the kinds {', '.join(KINDS)}, but its format is {form[:40]!r}."
            )
        fields, names = Fields(path, file), list[str]()
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        arrays = dict[str, np.ndarray]()
        for name in names:
            dataset, label = fields.dataset(name), fields.label(name)
            few = form == COMPACT
            arrays[name] = sound(label, get_whole(dataset, label).values() if few else np.asarray(dataset[()]))
        with as_written(path, "a whole object"):
            return _restored(kind, str(file.attrs["state"]), arrays)


def _restored(kind: str, text: str, arrays: Mapping[str, np.ndarray]) -> Stored:
    """The Object of a kind from its plain values (JSON) and its tensors."""
    plain = json.loads(text)
    require_plausible(plain)
    return KINDS[kind].from_state(joined({name: torch.from_numpy(a) for name, a in arrays.items()}, plain))


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
    """Write 1 to `MOST_OBJECTS` objects by their names, in this order, into one compact file, as near as `steps` say;
    `InputError` for none, or more."""
    require(0 < len(objects) <= MOST_OBJECTS, f"a series needs 1 to {MOST_OBJECTS} objects, but has {len(objects)}.")
    first, order, text = dict[str, Whole](), None, ""
    with new_hdf5(path) as file:
        file.attrs.update(format=SERIES, count=len(objects))
        for number, (name, obj) in enumerate(objects.items()):
            group = file.create_group(f"{number:06d}")
            own = order_of(obj)
            alike = isinstance(obj, GaussianCloud) and order is not None and len(obj) == len(order)
            order = own if number == 0 else order
            ways = []
            for one in [own, order] if alike else [own]:
                tensors, plain = parted(ordered(obj, one).state())
                step = {n: first[n].step for n in tensors if n in first}
                whole = {n: Whole.of(n, tensor, steps, step.get(n)) for n, tensor in tensors.items()}
                ways.append((sum(_least(w, first.get(n))[1] for n, w in whole.items()), len(ways), whole, plain))
            _, _, whole, plain = min(ways)
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
                arrays = {name: sound(fields.label(f"{key}/{name}"), w.values()) for name, w in whole.items()}
                found[str(group.attrs["name"])] = _restored(str(group.attrs["kind"]), text, arrays)
            if number == 0:
                first, state = whole, text
    require(len(found) > 0, f"{path} must hold objects, but it holds none.")
    return found


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
    changed = [name for name, dataset in own.items() if bool(dataset.attrs.get("from_first", False))]
    for name in (*same, *changed):
        known = name in first
        require(known, f"{label}/{name} must be in the first object, to which it refers, but it is not.")
    found = {name: first[name] for name in same}
    for name, dataset in own.items():
        where = f"{label}/{name}"
        found[name] = change = get_whole(dataset, where)
        if name in changed:
            begun = first[name].numbers
            require(begun.shape == change.numbers.shape, f"{where} must fit the first object's, but it does not.")
            found[name] = Whole(begun + change.numbers, change.step, change.dtype)
    return found


def names_of(paths: Sequence[Path]) -> list[str]:
    """Names of runs in a series: those of their folders, as much of the path as tells them apart."""
    parts = [path.resolve().parts for path in paths]
    for depth in range(1, max(map(len, parts), default=0) + 1):
        found = ["/".join(p[-depth:]) for p in parts]
        if len(set(found)) == len(found):
            return found
    raise InputError("the runs of a series must be different folders, but one is named twice.")
