"""Objects in few bytes: whole numbers of a step, differences from row to row, compressed (docs/export.md, "Compact").

What a tensor's numbers mean decides how fine they must be: places to a share of a pixel, logarithms of deviations to a
share of the deviation, quaternions to an angle, values to a share of their range. Gaussians stand in the order of a
curve that fills space (Morton 1966), so that neighbours in the file are neighbours in space.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import h5py
import numpy as np
import torch
from torch import Tensor

from ..checks import InputError, in_range
from ..ranges import checked_dataclass
from ..representations import GaussianCloud, Stored

FORMAT = "holosplat compact 1"
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

    def times(self, factor: float) -> Steps:
        """All of them, `factor` times as large."""
        return Steps(*(factor * value for value in vars(self).values()))

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
    return Steps().times(place_px / Steps.place)


def order_of(obj: Stored) -> Tensor | None:
    """The order [N] of the parts of an object that compresses well; None if it has no parts to be put in order."""
    if not isinstance(obj, GaussianCloud) or len(obj) == 0:
        return None
    return torch.from_numpy(_along_curve(obj.centres.detach().cpu().numpy()))


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
    """The dataset of a tensor, last axis first, with the attributes `step` (0: values as they are), `differences` along
    the rows where these take less, and `dtype`."""
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
    try:
        step, dtype = float(np.asarray(dataset.attrs["step"])), np.dtype(str(dataset.attrs["dtype"]))
        differences = bool(dataset.attrs["differences"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{label} must say its step, type and differences, but it lacks or garbles {error}.") from None
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


def _along_curve(places: np.ndarray) -> np.ndarray:
    """The order [N] of places [N, 3] along Morton's curve through 1024 cells an axis of their box."""
    low, high = places.min(axis=0), places.max(axis=0)
    cells = (1023 * (places - low) / np.maximum(high - low, 1e-30)).astype(np.int64)
    code = np.zeros(len(places), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
