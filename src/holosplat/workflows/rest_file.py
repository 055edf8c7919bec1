"""rest.vtp of a run of track: the shape at rest of bodies whose shape was told, or found."""

from __future__ import annotations

from typing import Any

from ..bodies.rest_shape import KnownBody
from ..checks import as_written, require
from ..io.vtk import read_meshes, write_mesh
from ..mesh import TriangleMesh
from ..motion.elastic import Rest
from ..representations import MovingSurfaces, Stored
from .run_folder import RunFolder

LENGTH_UNIT = "um"


def write_rest(folder: RunFolder, shape: TriangleMesh) -> None:
    """Write the mesh `shape` [m]."""
    write_mesh(folder.rest, shape, LENGTH_UNIT)


def read_rest(folder: RunFolder, found: Stored, config: dict[str, Any]) -> Rest | None:
    """What the run knows of the shape of its bodies `found` at rest; None where it knows nothing.

    config: what config.json holds. Errors: `InputError` for a mesh that is not of these bodies, and other damage.
    """
    if not (isinstance(found, MovingSurfaces) and folder.rest.is_file()):
        return None
    with as_written(folder.config, "what track wrote"):
        told = config["method"]["body"]  # None where red cells were found
        stiffness = KnownBody.stiffness if told is None else float(told["stiffness"])
    shape = read_meshes(folder.rest, LENGTH_UNIT)[0]
    own = [found.body(k)[1].numpy() for k in range(found.count)]
    fits = all(one.shape == shape.faces.shape and (one == shape.faces).all() for one in own)
    require(fits, f"{folder.rest} must have the triangles of the run's bodies, but it has others; bring back its own.")
    return Rest.of(shape, stiffness, found.unit_length)
