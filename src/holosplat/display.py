"""What Jupyter shows of objects, scans and runs: small tables and pictures in HTML, made when they are shown.

Nothing here needs Jupyter. All text is escaped, and pictures are part of the page.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .geometry import Grid, Views
from .units import beam_named

EDGE = 128
"""Pixels of a picture along its longer edge, about: larger ones are thinned out."""
BOX = 1 << 20
"""Voxels of the grid that says where an object lies."""
STYLE = (
    "display:inline-flex;gap:12px;align-items:flex-start;font:13px sans-serif;border:1px solid #8884;"
    "border-radius:6px;padding:8px 12px"
)
Picture = tuple[str, np.ndarray]
"""What stands below it, and its values [H, W], of which the least becomes black and the greatest white."""


def card(title: str, rows: Mapping[str, str], pictures: Sequence[Picture] = ()) -> str:
    """A table of `rows` below a title, and pictures beside it, as HTML."""
    lines = "".join(
        f'<tr><td style="text-align:left;opacity:.7">{html.escape(name)}</td>'
        f'<td style="text-align:left">{html.escape(text)}</td></tr>'
        for name, text in rows.items()
    )
    table = f"<div><b>{html.escape(title)}</b><table>{lines}</table></div>"
    return f'<div style="{STYLE}">{table}{"".join(map(_figure, pictures))}</div>'


def of_object(obj: Any) -> str:
    """An object that can be reconstructed: what it is, its matter, and ∫δ along z."""
    grid = obj.enclosing_grid(BOX)
    size = " × ".join(f"{1e6 * n * d:.3g}" for n, d in zip(grid.shape[::-1], grid.voxel_size))
    matter = " and ".join(f"δ {c.delta:.3g}, β {c.beta:.3g}" for c in obj.matter.channels)
    rows = {"kind": obj.kind, "made of": obj.described, "matter": matter, "box (x, y, z)": f"{size} µm"}
    lines = _lines(obj, grid)
    return card(type(obj).__name__, rows, [(f"∫δ dz, 0 to {1e9 * float(lines.max()):.3g} nm", lines)])


def of_volume(volume: Any) -> str:
    """δ and β on a grid, with the middle slice of each axis."""
    grid = volume.grid
    z, y, x = (n // 2 for n in grid.shape)
    rows = {
        "voxels (z, y, x)": " × ".join(map(str, grid.shape)),
        "edges (x, y, z)": " × ".join(f"{1e6 * d:.4g}" for d in grid.voxel_size) + " µm",
        "δ": f"{float(volume.delta.min()):.3g} to {float(volume.delta.max()):.3g}",
        "β": f"{float(volume.beta.min()):.3g} to {float(volume.beta.max()):.3g}",
    }
    slices = (("δ across z", volume.delta[z]), ("across y", volume.delta[:, y]), ("across x", volume.delta[:, :, x]))
    return card("Volume", rows, slices)


def of_scan(scan: Any) -> str:
    """Frames and how they were taken, with the first frame and the last, which alone are read."""
    exposures, (rows, columns) = scan.exposures, scan.views.shape
    said = {
        "frames": f"{len(scan)} of {rows} × {columns} pixels, {int(scan.is_test.sum())} held out",
        "pixel": f"{1e6 * scan.views.pitch:.4g} µm",
        **dict([beam_named(exposures.energy_kev)]),
        "distance": _span(exposures.distance, "m"),
        "times": f"{len(np.unique(exposures.time))}",
    }
    shown = [0, len(scan) - 1] if len(scan) > 1 else [0][: len(scan)]
    return card("Scan", said, [(f"frame {k}", np.asarray(scan.source[[k]])[0]) for k in shown])


def _span(values: np.ndarray, unit: str) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}"


def _lines(obj: Any, grid: Grid) -> np.ndarray:
    """∫δ dz [H, W] [m] over the field that holds the object, about the origin."""
    low, high = (np.array(axis)[[0, -1]] for axis in grid.axes()[:2])
    half = float(max(np.abs(low).max(), np.abs(high).max())) + grid.voxel_size[0]
    _, delta = obj.project(Views.from_angles([0.0], (EDGE, EDGE), 2 * half / EDGE))
    return np.asarray(delta.detach().cpu().numpy()[0], dtype=np.float64)


def _figure(picture: Picture) -> str:
    said, values = picture
    return (
        f'<figure style="margin:0;text-align:center"><img alt="{html.escape(said)}" src="{_png(values)}" '
        f'style="height:{EDGE}px"/><figcaption style="opacity:.7">{html.escape(said)}</figcaption></figure>'
    )


def _png(values: np.ndarray) -> str:
    """Values [H, W] as a grey PNG of 8 bits in a `data:` URI."""
    from PIL import Image  # which importing the package need not

    step = max(1, -(-max(values.shape) // (2 * EDGE)))
    shown = np.nan_to_num(np.asarray(values[::step, ::step], dtype=np.float64))
    low, high = float(shown.min()), float(shown.max())
    grey = np.rint(255 * (shown - low) / (high - low or 1.0)).astype(np.uint8)
    content = io.BytesIO()
    Image.fromarray(grey).save(content, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"
