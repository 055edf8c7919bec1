"""δ (or µ) and β as plain float32 numbers, x fastest, as files of VTK, NRRD and MRC hold them: written slab by slab.

Volumes of several times in HDF5 as one XDMF file (xdmf.org), for ParaView and VisIt: lengths in µm, times in s.
It holds no values, but names the HDF5 files relative to its folder, so that it can move with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import escape

import numpy as np

from ..checks import finite, require, require_regular
from ..geometry import Grid
from ..progress import Advance
from ..volume import Object
from .atomic import atomic_path
from .guard import require_memory
from .hdf5_writing import require_room
from .volumes import NAMES, REFRACTION, Contents, Stored, slab_rows, slabs_of

MICROMETRES = 1e6
LENGTH_UNIT = "um"
"""The unit of lengths in these files, as in those of bodies."""


def fill(
    places: Sequence[tuple[BinaryIO, int]],
    obj: Object,
    grid: Grid,
    on_progress: Advance = lambda fraction: None,
    of: Contents = REFRACTION,
) -> np.ndarray:
    """Write δ and β of `obj` on `grid`, or what else is `of` it, at `places`: for each an open file and the byte where
    its values begin.

    Returns their least and greatest values, means and standard deviations [2, 4].
    """
    _, y, x = grid.shape
    found = np.array([[np.inf, -np.inf, 0.0, 0.0]] * len(NAMES))
    for start, part in slabs_of(obj, grid, slab_rows(grid), on_progress):
        for (file, begin), array, row in zip(places, of.of_volume(part).values(), found):
            values = array.astype("<f4")
            for z, page in enumerate(values):
                file.seek(begin + 4 * x * (z * y + start))
                file.write(page.tobytes())
            row[:2] = min(row[0], values.min()), max(row[1], values.max())
            row[2:] += values.sum(dtype=np.float64), np.square(values, dtype=np.float64).sum()
    found[:, 2:] /= math.prod(grid.shape)
    found[:, 3] = np.sqrt(np.maximum(0.0, found[:, 3] - found[:, 2] ** 2))
    return found


def values_at(path: Path, begin: int, shape: tuple[int, ...], dtype: str = "<f4") -> np.ndarray:
    """The numbers of `shape` that stand in a file from the byte `begin` on. `InputError` for a file that is shorter."""
    wanted, held = begin + np.dtype(dtype).itemsize * math.prod(shape), path.stat().st_size
    require(
        wanted <= held,
        f"{path} must hold {wanted:.4g} bytes, as its header declares, but it has {held}; it is cut off or damaged.",
    )
    require_memory(str(path), wanted)
    return np.fromfile(path, dtype, math.prod(shape), offset=begin).reshape(shape)


def micrometres(grid: Grid) -> tuple[list[float], list[float]]:
    """The voxels' size and the first voxel's centre (x, y, z) [µm], to 12 digits."""
    size, origin = ([float(f"{MICROMETRES * v:.12g}") for v in of] for of in (grid.voxel_size, grid.origin))
    return size, origin


def both(path: Path) -> tuple[Path, Path]:
    """The files of δ and of β where a file holds one array: NAME.nrrd and NAME.beta.nrrd."""
    return path, path.with_suffix(f".beta{path.suffix}")


def write_both(
    path: Path, head: Callable[[str, np.ndarray], bytes], obj: Object, grid: Grid, on_progress: Advance, of: Contents
) -> None:
    """Write δ and β of `obj` on `grid` into two files (`both`), of which each begins with `head`.

    head: from the name of the array and its least and greatest value, mean and standard deviation [4]; of one length.
    """
    unknown = np.zeros(4)
    require_room(path, len(NAMES) * (len(head(next(iter(of.units)), unknown)) + 4 * math.prod(grid.shape)))
    with ExitStack() as stack:
        temporary = [stack.enter_context(atomic_path(one)) for one in both(path)]
        files = [stack.enter_context(one.open("wb")) for one in temporary]
        begins = [file.write(head(name, unknown)) for file, name in zip(files, of.units)]
        for file, name, row in zip(files, of.units, fill(list(zip(files, begins)), obj, grid, on_progress, of)):
            file.seek(0)
            file.write(head(name, row))


def read_both(path: Path, read_one: Callable[[Path], tuple[np.ndarray, Grid, Contents]]) -> Stored:
    """The volume of two files (`both`), each as `read_one` reads it. `InputError` where one is missing or differs."""
    first, beta = both(path)
    require(
        beta.is_file() or not first.is_file(),
        f"{path} holds one array; its β must lie beside it as {beta.name}, but there is no such file.",
    )
    for one in (first, beta):
        require_regular(one, f"a {path.suffix} file")
    (values, grid, of), (others, other, _) = (read_one(one) for one in (first, beta))
    require(grid == other, f"{first} and {beta.name} must be of the same voxels, but they differ; write both anew.")
    return Stored((finite(f"{first}", values), finite(f"{beta}", others)), grid, of)


def write_xdmf(path: Path, grid: Grid, steps: Sequence[tuple[float, Path]], of: Contents = REFRACTION) -> None:
    """Write the series of the volumes `steps`, each with its time [s], all on `grid`, in the folder of `path`."""
    size, origin = (" ".join(map(repr, reversed(lengths))) for lengths in micrometres(grid))
    shape = " ".join(map(str, grid.shape))
    lines = ['<?xml version="1.0"?>', "<!-- lengths in um, times in s -->", '<Xdmf Version="3.0"><Domain>']
    lines.append('<Grid Name="volumes" GridType="Collection" CollectionType="Temporal">')
    for time, file in steps:
        lines += [
            f'<Grid Name="volume" GridType="Uniform"><Time Value="{time!r}"/>',
            f'<Topology TopologyType="3DCoRectMesh" Dimensions="{shape}"/>',
            '<Geometry GeometryType="ORIGIN_DXDYDZ">',
            *(f'<DataItem Format="XML" Dimensions="3">{lengths}</DataItem>' for lengths in (origin, size)),
            "</Geometry>",
        ]
        for name in of.units:
            values = f'<DataItem Format="HDF" Dimensions="{shape}" NumberType="Float" Precision="4">'
            lines.append(
                f'<Attribute Name="{name}" AttributeType="Scalar" Center="Node">{values}{escape(file.name)}:/{name}'
                "</DataItem></Attribute>"
            )
        lines.append("</Grid>")
    lines += ["</Grid>", "</Domain></Xdmf>", ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
