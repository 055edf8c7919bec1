"""Volumes of δ and β from and to HDF5 (docs/scan_files.md), and those that a network guessed, with their spread."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..checks import InputError, finite, in_range, require, shaped
from ..geometry import Grid
from ..matter import Matter
from ..progress import Advance
from ..units import wavenumber
from ..volume import Object, Volume
from .hdf5 import Fields, attribute_numbers, new_hdf5, open_hdf5, put, room_for

NAMES = ("delta", "beta")
VOXEL_RANGE_M = (1e-10, 1e-2)
SAID = {"voxel_size_units": "m", "origin_units": "m", "axes": "z, y, x"}
"""Attributes for people and other programs; lengths are (x, y, z)."""
MU = "mu_per_m"
"""The attenuation coefficient, which stands in place of δ where that is not known."""
SEEN, LIKELY = "views", "matter"
"""How many views show each voxel, and the probability that it is matter."""
Beside = Mapping[str, Callable[[Grid], np.ndarray]]
"""What stands beside δ and β, by these names: numbers of the voxels of a grid, [Z, Y, X]."""
ALONE: Beside = {}
"""No more than δ and β."""
SLAB_VOXELS = 1 << 22
"""Voxels that `write_voxels` makes at once: meshes take about 250 MB for them."""


@dataclass(frozen=True)
class Contents:
    """What the two arrays of a volume file are: δ and β, or, where δ is not known, µ and β. mu_per_beta: µ/β [1/m]."""

    mu_per_beta: float | None

    @classmethod
    def of(cls, delta_told: bool, energy_kev: float) -> Contents:
        """δ and β where δ is told; else β, and the attenuation coefficient µ = 2kβ at `energy_kev` [keV]."""
        return cls(None) if delta_told else cls(2 * float(wavenumber(energy_kev)))

    @property
    def units(self) -> dict[str, str]:
        """Names of the arrays, with their units."""
        return dict.fromkeys(NAMES, "1") if self.mu_per_beta is None else {MU: "1/m", NAMES[1]: "1"}

    def of_volume(self, volume: Volume) -> dict[str, np.ndarray]:
        """The arrays [Z, Y, X] float32 by name."""
        first = volume.delta if self.mu_per_beta is None else volume.beta * np.float32(self.mu_per_beta)
        return dict(zip(self.units, (first, volume.beta)))

    def of_matter(self, matter: Matter) -> dict[str, float]:
        """The constants of one material by name."""
        first = matter.delta if self.mu_per_beta is None else matter.beta * self.mu_per_beta
        return dict(zip(self.units, (first, matter.beta)))


REFRACTION, ABSORPTION = Contents(None), Contents.of(False, 1.0)
"""The latter at any energy, for its names and units."""


def contents_of(said: str) -> Contents:
    """What the arrays of a file are that says so of them, in names or a description."""
    return ABSORPTION if MU in said else REFRACTION


@dataclass(frozen=True)
class Stored:
    """A volume as a file holds it: two arrays [Z, Y, X] float32 on a grid, and what they are."""

    arrays: tuple[np.ndarray, np.ndarray]
    grid: Grid
    of: Contents = REFRACTION

    def volume(self, path: str | Path, delta_told: bool = True) -> Volume:
        """The volume; without delta_told β stands for δ. `InputError` with the path where µ stands in place of δ."""
        if not delta_told:
            return Volume(self.arrays[1], self.arrays[1], self.grid)
        require(
            self.of is not ABSORPTION,
            f"{path} must hold δ, but it holds the attenuation coefficient µ; take a volume of δ and β.",
        )
        return Volume(*self.arrays, self.grid)


def read_volume(path: str | Path) -> Volume:
    """Read a volume from an HDF5 file with /delta and /beta [Z, Y, X].

    The attributes `voxel_size` and `origin` [m] may be on the datasets, on the file's root, or both (then they must
    agree); voxel_size is one number or three, `(dx, dy, dz)`. Errors: `InputError` naming the file and the field at
    fault.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> grid = hs.Grid.centred((4, 4, 4), voxel_size=1e-6)
        >>> volume = hs.Volume(np.full(grid.shape, 5.8e-7), np.full(grid.shape, 2.6e-10), grid)
        >>> hs.write_volume("volume.h5", volume)
        >>> found = hs.read_volume("volume.h5")
        >>> found.grid == grid, f"{found.delta.mean():.1e}"
        (True, '5.8e-07')
    """
    return read_stored(path).volume(path)


def read_stored(path: str | Path) -> Stored:
    """The same of a file that may hold /mu_per_m in place of /delta."""
    with open_hdf5(path) as file:
        of = contents_of(" ".join(file))
        fields, names = Fields(Path(path), file), tuple(of.units)
        first, beta = (_array(fields, name) for name in names)
        if first.shape != beta.shape:
            raise InputError(
                f"{path}: /{names[0]} and /beta must have the same shape, but they have {first.shape} and {beta.shape}."
            )
        size = np.broadcast_to(_attribute(fields, names, "voxel_size", (1, 3)), (3,))
        origin = _attribute(fields, names, "origin", (3,))
    return Stored((first, beta), grid_of(Path(path), first.shape, size.tolist(), origin.tolist()), of)


def grid_of(path: Path, shape: Sequence[int], size: Sequence[float], origin: Sequence[float]) -> Grid:
    """The grid of the file `path` from its (Z, Y, X) voxels, their size and the first one's centre (x, y, z) [m]."""
    for number in size:
        in_range(f"{path}: voxel_size", float(number), *VOXEL_RANGE_M, unit="metres")
    (z, y, x), (dx, dy, dz) = map(int, shape), map(float, size)
    ox, oy, oz = map(float, finite(f"{path}: origin", np.asarray(origin)))
    return Grid((z, y, x), (dx, dy, dz), (ox, oy, oz))


def write_volume(path: str | Path, volume: Volume) -> None:
    """Write a volume to an HDF5 file as /delta and /beta with their grid; `path` is replaced only once all is written.

    `export` writes other formats. Errors: `InputError` where `path` cannot be written.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> grid = hs.Grid.centred((4, 4, 4), voxel_size=1e-6)
        >>> volume = hs.Volume(np.full(grid.shape, 5.8e-7), np.full(grid.shape, 2.6e-10), grid)
        >>> hs.write_volume("volume.h5", volume)
        >>> print(hs.info("volume.h5").rows["shape"])
        4 × 4 × 4 voxels (z, y, x)
    """
    write_slabs(path, volume.grid, [(0, volume)])


def write_slabs(
    path: str | Path,
    grid: Grid,
    slabs: Iterable[tuple[int, Volume]],
    of: Contents = REFRACTION,
    beside: Beside = ALONE,
) -> None:
    """Write the volume on `grid` from `slabs` that cover it, each with the y index of its first slice, and what is
    `beside` it of each voxel; `path` is replaced only once all are written."""
    attributes = {"voxel_size": np.array(grid.voxel_size), "origin": np.array(grid.origin), **SAID}
    with new_hdf5(path, 4 * (len(NAMES) + len(beside)) * math.prod(grid.shape)) as file:
        file.attrs.update(attributes)
        chunk = (grid.shape[0], 1, grid.shape[2])  # slabs are whole in z and x
        units = of.units | dict.fromkeys(beside, "1")
        types = dict.fromkeys(units, np.float32) | {SEEN: np.uint16}
        arrays = {name: room_for(file, name, grid.shape, types[name], chunk=chunk) for name in units}
        for name, array in arrays.items():
            array.attrs.update({**attributes, "units": units[name]})
            for dimension, axis in zip(array.dims, "zyx"):
                dimension.label = axis
        for start, part in slabs:
            more = {name: of_grid(part.grid) for name, of_grid in beside.items()}
            for name, values in (of.of_volume(part) | more).items():
                arrays[name][:, start : start + part.grid.shape[1]] = values


def write_voxels(
    path: str | Path,
    obj: Object,
    grid: Grid,
    on_progress: Advance = lambda fraction: None,
    of: Contents = REFRACTION,
    beside: Beside = ALONE,
) -> None:
    """Write `obj` on `grid`, `SLAB_VOXELS` voxels at a time; `on_progress(fraction)` is called after each slab."""
    write_slabs(path, grid, slabs_of(obj, grid, slab_rows(grid), on_progress), of, beside)


def slab_rows(grid: Grid) -> int:
    """Rows along y of `SLAB_VOXELS` voxels; at least one."""
    return max(1, SLAB_VOXELS // (grid.shape[0] * grid.shape[2]))


def slabs_of(
    obj: Object, grid: Grid, rows: int, on_progress: Advance = lambda fraction: None
) -> Iterator[tuple[int, Volume]]:
    """`obj` voxelised on `grid` in slabs of `rows` rows along y, each with the index of its first."""
    for start in range(0, grid.shape[1], rows):
        stop = min(start + rows, grid.shape[1])
        block = grid.block((0, start, 0), (grid.shape[0], stop - start, grid.shape[2]))
        yield start, obj.voxelise(block)
        on_progress(stop / grid.shape[1])


def _array(fields: Fields, name: str) -> np.ndarray:
    data = fields.dataset(fields.need(name))
    if data.ndim != 3 or 0 in data.shape:
        raise InputError(f"{fields.label(name)} must have the shape [Z, Y, X], but it has {data.shape}.")
    return finite(fields.label(name), data[()].astype(np.float32))


def _attribute(fields: Fields, datasets: Sequence[str], name: str, counts: tuple[int, ...]) -> np.ndarray:
    """The attribute `name` of the datasets and the root, wherever it stands."""
    places = [fields.group, *(fields.group[dataset] for dataset in datasets)]
    label = f"{fields.path}: @{name}"
    found = [attribute_numbers(label, place.attrs[name], counts) for place in places if name in place.attrs]
    if not found:
        raise InputError(f"{label} (in metres, on /{datasets[0]} or the file's root) must be there, but it is missing.")
    if not all(np.allclose(value, found[0], rtol=1e-6, atol=1e-15, equal_nan=True) for value in found):
        values = ", ".join(str(value.tolist()) for value in found)
        raise InputError(f"{label} must be the same on the datasets and the root, but it is {values}.")
    return found[0]


SPREAD = "spread"
OF, VIEWS, COPIES = "of", "views", "copies"
"""An attribute of the spread: of guesses without one of the views each, or of copies of the scene."""


def write_guess(path: Path, volume: Volume, spread: np.ndarray | None, of_copies: bool = False) -> None:
    """Write guessed δ and β as `write_volume` does, and /spread [Z, Y, X], the standard deviation of occupancy, if
    there is one; of_copies: in guesses of copies of the scene, else of its views."""
    with new_hdf5(path, 12 * volume.delta.size) as file:
        file.attrs.update({"voxel_size": np.array(volume.grid.voxel_size), "origin": np.array(volume.grid.origin)})
        for name in NAMES:
            put(file, name, getattr(volume, name))
        if spread is not None:
            put(file, SPREAD, spread.astype(np.float32)).attrs[OF] = COPIES if of_copies else VIEWS


def read_guess(path: Path) -> tuple[Volume, np.ndarray | None, bool]:
    """What `write_guess` wrote: the volume, the spread, and whether that is of copies; `InputError` for other files."""
    volume = read_volume(path)
    with open_hdf5(path) as file:
        fields = Fields(path, file)
        if fields.find(SPREAD) is None:
            return volume, None, False
        dataset = fields.dataset(SPREAD)
        values, of_copies = np.asarray(dataset[()], dtype=np.float32), dataset.attrs.get(OF) == COPIES
    return volume, finite(f"{path}: /spread", shaped(f"{path}: /spread", values, volume.grid.shape)), of_copies
