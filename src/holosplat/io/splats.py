"""Gaussians as the PLY files of splat viewers: the layout of Kerbl et al. (2023), spherical harmonics of degree 0.

Those viewers blend opacities from back to front, `C = Σ c_i α_i Π (1 - α_j)`; our Gaussians add up. With one colour
blending gives `1 - Π (1 - α_i)`, whatever the order, and with `α_i = 1 - exp(-τ_i)` that is `1 - exp(-Σ τ_i)`: the
look of a body that absorbs, of an optical depth in proportion to the thickness. So τ is chosen; docs/export.md says
what is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ..checks import finite, require, shaped
from ..geometry import Views
from ..representations import GaussianCloud
from ..representations.gaussians import unit_quaternions
from .atomic import atomic_path

MICROMETRES = 1e6
DEPTH = 3.0
"""Optical depth of the thickest ray along the beam at angle 0: 95 % opaque."""
OPAQUE = 0.99
"""The largest opacity, as viewers clip it."""
MOST_PIXELS = 512
"""Pixels along an edge of the image in which the thickest ray is looked for."""
COLOURS = np.array([[0.90, 0.85, 0.78], [0.30, 0.55, 0.85]])
"""Of the first material, and of the second; then of both again."""
CONSTANT = 0.5 / math.sqrt(math.pi)
"""The spherical harmonic of degree 0: viewers show 0.5 + CONSTANT f_dc."""
NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{k}" for k in range(3)),
    "opacity",
    *(f"scale_{k}" for k in range(3)),
    *(f"rot_{k}" for k in range(4)),
)
"""Properties of a Gaussian in the file, float32, in this order."""


def write_splats(path: Path, cloud: GaussianCloud) -> None:
    """Write the Gaussians of `cloud` for splat viewers; `InputError` if there are none."""
    require(len(cloud) > 0, "a file of splats needs at least one Gaussian, but the object has none.")
    with torch.no_grad():
        rows = splats_of(cloud)
    note = f"holosplat: um, optical depth {DEPTH:g} where the object is thickest along z"
    write_vertices(path, rows, (note,))


def splats_of(cloud: GaussianCloud) -> np.ndarray:
    """The rows of the file, [N] with the fields `NAMES`: in µm; scales as logarithms, opacities as logits."""
    unit = MICROMETRES * cloud.unit_length
    alpha = opacities(cloud)
    columns = [
        (unit * cloud.centres.double()).numpy(),
        np.zeros((len(cloud), 3)),
        (colours(cloud) - 0.5) / CONSTANT,
        np.log(alpha / (1 - alpha))[:, None],
        cloud.log_scales.double().numpy() + math.log(unit),
        unit_quaternions(cloud.quaternions.double()).numpy(),
    ]
    values = np.concatenate(columns, axis=1).astype("<f4")
    return values.view([(name, "<f4") for name in NAMES]).reshape(-1)


def opacities(cloud: GaussianCloud, deepest: float = DEPTH) -> np.ndarray:
    """α [N] at the middle of each Gaussian: its peak thickness from the mean direction, over that of the thickest ray
    along z, which has the optical depth `deepest`."""
    shown = len(cloud.matter) if cloud.matter.occupancies else 1  # of free δ and β, δ
    half = float(cloud.centres[:, :2].abs().max()) + 1
    pixel = max(1.0, 2 * half / MOST_PIXELS)
    edge = math.ceil(2 * half / pixel)
    rays = cloud.thickness(Views.from_angles([0.0], (edge, edge), pixel * cloud.unit_length))[0, :shown].sum(dim=0)
    thickest = float(rays.max())
    mean_scale = cloud.scales.double().prod(dim=1) ** (1 / 3)
    own = cloud.amplitudes.double()[:, :shown].sum(dim=1) * math.sqrt(2 * math.pi) * mean_scale
    depth = own.numpy() * (deepest / thickest if thickest > 0 else 0.0)
    return np.clip(-np.expm1(-depth), 1e-6, OPAQUE)


def colours(cloud: GaussianCloud) -> np.ndarray:
    """Colours [N, 3], 0 to 1: one for one material, mixed by their shares where there are several."""
    if not cloud.matter.others:
        return np.broadcast_to(COLOURS[0], (len(cloud), 3))
    amplitudes = cloud.amplitudes.double().numpy()
    shares = amplitudes / np.maximum(amplitudes.sum(axis=1, keepdims=True), 1e-30)
    return shares @ COLOURS[np.arange(shares.shape[1]) % len(COLOURS)]


POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in ("red", "green", "blue")]
)
"""A point of the file: position, normal (which these programs ask for, and do not use), colour."""


def write_ply(path: str | Path, points: np.ndarray, grey: int = 128) -> None:
    """Write points [N, 3], in whatever unit, as binary little-endian PLY; all have the colour (grey, grey, grey)."""
    shaped("points", finite("points", np.asarray(points, dtype=np.float64)), (None, 3))
    rows = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for name in ("red", "green", "blue"):
        rows[name] = grey
    write_vertices(path, rows)


def write_vertices(path: str | Path, rows: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write the vertices `rows` [N], whose fields are little-endian float32 or uint8, with lines of comment."""
    kinds = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar"}
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(rows)}"]
    header += [f"property {kinds[rows.dtype[name]]} {name}" for name in rows.dtype.names or ()]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(rows.tobytes())
