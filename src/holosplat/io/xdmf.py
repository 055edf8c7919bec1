"""Volumes of several times in HDF5 as one XDMF file (xdmf.org), for ParaView and VisIt: lengths in µm, times in s.

It holds no values, but names the HDF5 files relative to its folder, so that it can move with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from ..geometry import Grid
from .atomic import atomic_path
from .plain_values import micrometres
from .volumes import REFRACTION, Contents


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
