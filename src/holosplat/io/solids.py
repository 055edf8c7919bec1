"""Closed bodies and Gaussians for other programs: STL, glTF 2.0 in one file (GLB), and PLY files of splat viewers.

Lengths in STL and GLB are micrometres; a node of the GLB scales them to metres, which glTF asks for, and turns them so
that y points up (Khronos, glTF 2.0, sections 3.4 and 5).

Splats have the layout of Kerbl et al. (2023), spherical harmonics of degree 0. Those viewers blend opacities from back
to front, `C = Σ c_i α_i Π (1 - α_j)`; our Gaussians add up. With one colour blending gives `1 - Π (1 - α_i)`, whatever
the order, and with `α_i = 1 - exp(-τ_i)` that is `1 - exp(-Σ τ_i)`: the look of a body that absorbs, of an optical
depth in proportion to the thickness. So τ is chosen; docs/export.md says what is lost.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..checks import finite, require, shaped
from ..geometry import Views
from ..matter import Matter
from ..mesh import TriangleMesh
from ..representations import GaussianCloud, MovingSurfaces
from ..representations.gaussians import unit_quaternions
from ..version import __version__
from .atomic import atomic_path
from .volumes import REFRACTION, Contents

MICROMETRES = 1e6
PLAY_S = 4.0
"""How long a film of moving bodies takes: their own times, microseconds say, are too short to be seen."""
FINE = 4
"""Key frames of the film for each time of the scan: between them weights are straight lines, paths are splines."""
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
FLOAT, UNSIGNED = 5126, 5125
VERTICES, INDICES = 34962, 34963
"""Numbers by which glTF names types and targets of buffers."""


def write_stl(path: Path, bodies: Sequence[TriangleMesh]) -> None:
    """Write all bodies as one binary STL file, in micrometres (which its header says), axes as ours."""
    require(len(bodies) > 0, "an STL file needs at least one body.")
    corners = np.concatenate([MICROMETRES * body.vertices[body.faces] for body in bodies])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(corners), FACET)
    facets["corners"] = corners
    facets["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    header = f"holosplat {__version__}: {len(bodies)} bodies, lengths in um"
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii").ljust(80) + struct.pack("<I", len(facets)))
        file.write(facets.tobytes())


def write_glb(path: Path, bodies: Sequence[TriangleMesh], matter: Sequence[Matter], of: Contents = REFRACTION) -> None:
    """Write still bodies as a GLB file, a node each; δ and β (or µ and β) of their `matter` are extras of materials."""
    require(len(bodies) > 0, "a GLB file needs at least one body.")
    file = _Glb([])
    for body, filling in zip(bodies, matter):
        file.add(body.name, of.of_matter(filling), body.vertices, body.faces)
    file.write(path)


def write_moving_glb(path: Path, moving: MovingSurfaces, times: Sequence[float], of: Contents = REFRACTION) -> None:
    """Write moving bodies as a GLB file with an animation of `PLAY_S` from the first of `times` [T] [s] to the last.

    Weights of B-splines add up to one, so that a path Σ w_k c_k is c_0 + Σ w_k (c_k - c_0): the differences are morph
    targets, and the animation gives their weights.
    """
    file, constants = _Glb([]), of.of_matter(moving.matter)
    shown = np.linspace(times[0], times[-1], FINE * (len(times) - 1) + 1)
    weights = moving.basis.weights(shown)[:, 1:]
    paths = moving.coefficients.detach().double().numpy() * moving.unit_length
    for number in range(moving.count):
        used, faces = moving.body(number)
        own = paths[:, used.numpy()]
        file.add(f"body{number:03d}", constants, own[0], faces.numpy(), own[1:] - own[0], weights[0])
    if len(times) > 1 and weights.shape[1] > 0:
        file.animate(weights, {"first_s": float(times[0]), "last_s": float(times[-1])})
    file.write(path)


@dataclass
class _Glb:
    """A glTF document as it grows, and its bytes."""

    constants: list[dict[str, float]]
    blob: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    animations: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self,
        name: str,
        constants: dict[str, float],
        vertices: np.ndarray,
        faces: np.ndarray,
        targets: np.ndarray | Sequence[np.ndarray] = (),
        weights: np.ndarray | Sequence[float] = (),
    ) -> None:
        """Add a body: vertices [P, 3] [m], constants of its matter, morph targets [K, P, 3] [m], first weights [K]."""
        self.constants += [] if constants in self.constants else [constants]
        material = self.constants.index(constants)
        primitive: dict[str, Any] = {"attributes": {"POSITION": self._places(vertices)}, "material": material}
        primitive["indices"] = self._stored(faces.reshape(-1).astype("<u4"), "SCALAR", UNSIGNED, INDICES)
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if len(targets):
            primitive["targets"] = [{"POSITION": self._places(target)} for target in targets]
            mesh["weights"] = [float(w) for w in weights]
        self.meshes.append(mesh)

    def animate(self, weights: np.ndarray, extras: dict[str, float]) -> None:
        """Weights [T, K] of the targets of all meshes, even over `PLAY_S`."""
        when = np.linspace(0.0, PLAY_S, len(weights)).astype("<f4")
        times = self._stored(when, "SCALAR", FLOAT, None, limits=True)
        values = self._stored(weights.reshape(-1).astype("<f4"), "SCALAR", FLOAT, None)
        channels = [{"sampler": 0, "target": {"node": 1 + mesh, "path": "weights"}} for mesh in range(len(self.meshes))]
        sampler = {"input": times, "output": values, "interpolation": "LINEAR"}
        self.animations.append({"name": "motion", "channels": channels, "samplers": [sampler], "extras": extras})

    def write(self, path: Path) -> None:
        """The document and its bytes as one file."""
        text = json.dumps(self._document(), separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        blob = bytes(self.blob) + b"\0" * (-len(self.blob) % 4)
        total = 12 + 8 + len(text) + 8 + len(blob)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(blob), b"BIN\0") + blob)

    def _document(self) -> dict[str, Any]:
        note = "The accessors hold micrometres, y down; the first node scales to metres and turns y up."
        first = {
            "name": "object",
            "scale": [1 / MICROMETRES] * 3,
            "rotation": [1.0, 0.0, 0.0, 0.0],
            "children": [1 + k for k in range(len(self.meshes))],
        }
        nodes = [first, *({"name": mesh["name"], "mesh": k} for k, mesh in enumerate(self.meshes))]
        colour = {"baseColorFactor": [0.75, 0.2, 0.15, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.6}
        return {
            "asset": {"version": "2.0", "generator": f"holosplat {__version__}", "extras": {"note": note}},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": self.meshes,
            "materials": [
                {"name": "matter", "pbrMetallicRoughness": colour, "extras": each} for each in self.constants
            ],
            **({"animations": self.animations} if self.animations else {}),
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.blob) + -len(self.blob) % 4}],
        }

    def _places(self, vertices: np.ndarray) -> int:
        """The accessor of vertices [P, 3] [m]."""
        scaled = (MICROMETRES * vertices).astype("<f4")
        return self._stored(scaled, "VEC3", FLOAT, VERTICES, limits=True)

    def _stored(self, values: np.ndarray, kind: str, component: int, target: int | None, limits: bool = False) -> int:
        """The accessor of values in a view of the buffer of their own."""
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": values.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.blob.extend(values.tobytes())  # always whole words of four bytes
        accessor = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(values), "type": kind}
        if limits:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


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
    unit = MICROMETRES * cloud.unit_length
    with torch.no_grad():
        alpha = opacities(cloud)
        columns = [  # in µm; scales as logarithms, opacities as logits
            (unit * cloud.centres.double()).numpy(),
            np.zeros((len(cloud), 3)),
            (colours(cloud) - 0.5) / CONSTANT,
            np.log(alpha / (1 - alpha))[:, None],
            cloud.log_scales.double().numpy() + math.log(unit),
            unit_quaternions(cloud.quaternions.double()).numpy(),
        ]
    values = np.concatenate(columns, axis=1).astype("<f4")
    note = f"holosplat: um, optical depth {DEPTH:g} where the object is thickest along z"
    write_vertices(path, values.view([(name, "<f4") for name in NAMES]).reshape(-1), (note,))


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
