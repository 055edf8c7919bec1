"""`holosplat calibrate`: where beams are, by a body of known shape."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..checks import require
from ..io.reading import Part, Reading
from ..ranges import Small, ranged
from .light import Degrees, LightFlags, Pixels, Share
from .options import MaterialOptions
from .places import Output
from .progress import ProgressBar

if TYPE_CHECKING:
    from ..align import Calibrated, CalibrationOptions
    from ..mesh import TriangleMesh

LIGHT = LightFlags()
"""Even, unless the air of frames says otherwise."""


@dataclass(frozen=True)
@ranged
class BodyOptions:
    """The known shape: a mesh, or beads."""

    phantom: Path | None = None
    """Closed mesh of the phantom (.stl, .ply, .obj, .vtk, .vtp, .vtu); its pose in the file does not matter."""
    length_unit: str = "um"
    """Unit of the mesh file's coordinates."""
    beads: Small | None = None
    """Or: radius of beads [m], of any number, anywhere in the field."""

    def body(self) -> TriangleMesh | float:
        """The mesh [m], or the radius [m]. Errors: `InputError` unless one of them is given."""
        from ..io.vtk import read_meshes
        from ..specimens.repair import closed

        require((self.phantom is None) != (self.beads is None), "give either --phantom FILE or --beads RADIUS.")
        if self.phantom is None:
            return self.beads or 0.0
        require(
            not self.phantom.is_dir(), f"--phantom must be one file, but {self.phantom} is a folder; name the file."
        )
        return closed(read_meshes(self.phantom, self.length_unit)[0], self.length_unit)


@dataclass(frozen=True)
@ranged
class DoubtOptions:
    """How far off the plan each view may be: standard deviations. 0 keeps it as planned."""

    uncertain_shift: Pixels = 5.0
    """Detector's shifts along rows and columns [pixels]."""
    uncertain_angle: Degrees = 2.0
    """Turns about the two axes across the beam [degrees]."""
    uncertain_roll: Degrees = 2.0
    """Turns about the beam [degrees]."""
    uncertain_distance: Share = 0.05
    """Distance, as a share of it."""
    uncertain_pixel: Share = 0.0
    """Pixel size, as a share of it."""

    def options(self) -> CalibrationOptions:
        """The options of the search."""
        from ..align import CalibrationOptions, PosePrior

        shift, angle, roll, distance, pixel = vars(self).values()
        return CalibrationOptions(PosePrior(shift, angle, roll, distance), pixel)


def calibrate(
    scan: Positional[Path],
    out: Output,
    body: BodyOptions,
    filling: MaterialOptions = MaterialOptions(),
    unknown: DoubtOptions = DoubtOptions(),
    reading: Reading = Reading(),
    *,
    illumination: LightFlags = LIGHT,
) -> None:
    """Find where beams are by frames of a phantom of known shape, or of beads, for --exposures of other commands.

    Args:
        scan: Scan of the phantom: a file (NXtomo), or a folder.
        out: Geometry to write (TOML).
    """
    from ..align import calibrate as find
    from ..io.atomic import require_writable
    from ..io.formats import read_frames
    from ..matter import MaterialPrior

    require_writable(out)
    whole = reading.part == Part(time_frame=reading.part.time_frame)
    require(whole, "a geometry is that of whole frames; leave --views, --test-views, --crop and --bin.")
    require(filling.material is not None, "calibrate needs the phantom's --material; add it.")
    shape, measured = body.body(), read_frames(scan, reading).in_memory()
    material = filling.filling().of("", measured.exposures.reference_energy)
    with ProgressBar() as bar:
        found = find(
            measured,
            MaterialPrior.known(material),
            shape,
            unknown.options(),
            light=illumination.options(),
            on_progress=lambda stage, done: bar.show(stage, done, {}),
        )
    for line in found.lines():
        print(line)
    _write(out, scan, found)
    print(f"wrote {out}: the geometry of {len(measured)} beams, for --exposures", file=sys.stderr)


def _write(out: Path, scan: Path, found: Calibrated) -> None:
    from ..io.beams import Beams, write_beams

    beams = Beams.of(found.exposures, found.errors, {"scan": str(scan), "calibrated": found.lines()[0]})
    size, doubt = found.pixel_size
    write_beams(out, beams.with_pixel_size(size) if doubt else beams)
