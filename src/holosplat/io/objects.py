"""Objects of every kind as HDF5 files: tensors as datasets, everything else as one JSON attribute."""

from __future__ import annotations

import json
from collections.abc import Mapping
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
from ..representations import KINDS, Stored
from ..representations.gaussians import PARAMETERS, GaussianCloud
from . import compact
from .hdf5 import Fields, attribute_numbers, open_hdf5
from .hdf5_writing import new_hdf5, put

FORMAT = "holosplat object 1"
MOST_TEXT = 60_000
"""Characters of the attribute, at most: HDF5 holds 64 kB of them."""


def write_object(path: Path, obj: Stored, marks: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write an Object: the attributes `format`, `kind` and `state` (JSON), and a dataset for each of its tensors.

    marks: further attributes."""
    tensors, plain = parted(obj.state())
    text = json.dumps(plain)
    assert len(text) < MOST_TEXT
    with new_hdf5(path) as file:
        file.attrs.update(marks, format=FORMAT, kind=obj.kind, state=text)
        for name, tensor in tensors.items():
            put(file, name, tensor.detach().cpu().numpy())


def write_compact(path: Path, obj: Stored, steps: compact.Steps) -> None:
    """Write an Object in few bytes, as near as `steps` say; `read_object` reads it."""
    tensors, plain = parted(compact.ordered(obj, compact.order_of(obj)).state())
    text = json.dumps(plain)
    assert len(text) < MOST_TEXT
    with new_hdf5(path) as file:
        file.attrs.update(format=compact.FORMAT, kind=obj.kind, state=text)
        compact.encode(file, tensors, steps)


def read_object(path: Path) -> Stored:
    """The Object that `write_object` or `write_compact` wrote, or the Gaussians of a file of version 0.1; `InputError`
    for any other."""
    with open_hdf5(path) as file:
        form = str(file.attrs.get("format", ""))
        require(
            form != compact.SERIES,
            f"{path} must hold one object, but it holds a series of them; choose one with holosplat.io.series.",
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
        decoded = compact.decode if form == compact.FORMAT else lambda dataset, label: np.asarray(dataset[()])
        arrays = {n: sound(fields.label(n), decoded(fields.dataset(n), fields.label(n))) for n in names}
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
