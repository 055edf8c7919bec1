"""`holosplat align | calibrate`: where the beams of a scan really are, by its matter or by a body of known shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tyro.conf import Positional

from ..checks import require
from ..io.atomic import require_writable, write_rows
from ..io.reading import Part, Reading
from ..ranges import Small, checked_dataclass
from ..scan import Exposures, Scan
from .light import Degrees, LightFlags, Pixels, Share
from .options import MaterialOptions, PriorOptions
from .places import Output
from .progress import ProgressBar
from .sentence import put, say, tell_frames

if TYPE_CHECKING:
    from ..align import AlignedViews, PoseOptions, PosePrior
    from ..mesh import TriangleMesh


TOML = ".toml"


@checked_dataclass
class PoseFlags:
    """How far off the plan each view may be: standard deviations. 0 keeps it as planned."""

    uncertain_shift: Pixels = 2.0
    """Detector's shifts along rows and columns [pixels]."""
    uncertain_angle: Degrees = 1.0
    """Turns about the two axes across the beam [degrees]."""
    uncertain_roll: Degrees = 1.0
    """Turns about the beam [degrees]."""
    uncertain_distance: Share = 0.0
    """Distance, as a share of it: only where fringes are resolved."""

    def prior(self) -> PosePrior:
        """The same as a prior of poses."""
        from ..align import PosePrior

        return PosePrior(self.uncertain_shift, self.uncertain_angle, self.uncertain_roll, self.uncertain_distance)


@checked_dataclass
class MagnifiedFlags(PoseFlags):
    """The same, and the magnification."""

    uncertain_magnification: Share = 0.0
    """Magnification, as a share of it; that of all training frames together is as planned."""

    def prior(self) -> PosePrior:
        """The same as a prior of poses."""
        return replace(super().prior(), magnification=self.uncertain_magnification)


@checked_dataclass
class UncertainOptions(MagnifiedFlags):
    """How far off the plan each view may be: standard deviations. 0 keeps it as planned."""

    drift_shift: Pixels = 0.0
    """Of a series: how far each beam's shifts drift from the first time to the last [pixels]."""
    drift_angle: Degrees = 0.0
    """Of a series: how far each beam turns from the first time to the last [degrees]."""

    def options(self) -> PoseOptions:
        """The options of the search."""
        from ..align import Drift, PoseOptions

        return PoseOptions(self.prior(), drift=Drift(self.drift_shift, self.drift_angle))


@checked_dataclass
class RefineOptions(MagnifiedFlags):
    """Beams that may be elsewhere than the scan says."""

    refine: str | None = None
    """What is found of each frame beside the matter: shifts, angles, roll, distance, magnification, with commas
    (default: none)."""

    def options(self) -> PoseOptions | None:
        """The options of the search; None where nothing is to be refined. Errors: `InputError` for other names."""
        if self.refine is None:
            usual = vars(AS_SAID)
            changed = [name.replace("_", "-") for name, value in vars(self).items() if value != usual[name]]
            require(not changed, f"--{', --'.join(changed)} go with --refine, which says what is uncertain; add it.")
            return None
        from ..align import PoseOptions
        from ..align.geometry import wanted

        return PoseOptions(wanted(self.refine, self.prior()))


AS_SAID = RefineOptions(uncertain_distance=0.02, uncertain_magnification=0.01)
"""Beams are where the scan says; how far off they may be where --refine asks for them."""


def align(
    scan: Positional[Path],
    out: Output,
    matter: PriorOptions = PriorOptions(),
    unknown: UncertainOptions = UncertainOptions(),
    reading: Reading = Reading(),
    *,
    illumination: LightFlags = LightFlags(),
    axis_only: bool = False,
    table: Output | None = None,
    geometry_out: Output | None = None,
) -> None:
    """Find where the beams of a scan really are, and write the same frames with other exposures.

    Args:
        scan: Scan: a file (NXtomo), or a folder (tiff, nerf-synthetic, r2-gaussian, or a run's).
        out: Scan file to write (NXtomo).
        axis_only: The object turns about one axis; find its column, and how it leans in the image, in seconds.
        table: Also write what was found of each view, with errors (CSV).
        geometry_out: Also write the geometry of all beams (TOML), which --exposures takes for other scans of them.
    """
    from ..align import AlignedBeams, align_views, find_axis
    from ..io.formats import read_frames
    from ..io.larger_frames import heightened, of_parts
    from ..io.nxtomo import write_scan
    from ..planning.acts import of_alignment
    from ..workflows.preconditions import check_frames

    for path in (out, *([table] if table else []), *([geometry_out] if geometry_out else [])):
        require_writable(path)
    require(
        out.suffix.lower() != TOML,
        f"--out must be the scan to write, NAME.nxs, but it is {out}; the geometry alone is --geometry-out.",
    )
    require(table is None or not axis_only, "--table is of single views; leave it, or --axis-only.")
    require(geometry_out is None or reading.part.views is None, "--geometry-out is of all frames; leave --views.")
    measured, how = read_frames(scan, reading, joined=False), unknown.options()
    if not axis_only:
        tell_frames("align", measured.exposures, out, lambda seen: of_alignment(seen, how))
    measured = measured.in_memory()
    check_frames(measured)
    prior = matter.prior(measured.exposures.reference_energy, reading.told.wall)
    errors, frames, missing, lasting = None, measured.source, measured.missing, np.arange(len(measured))
    if axis_only:
        with ProgressBar() as bar:
            light, show = illumination.options(), bar.of("axis")
            axis = find_axis(measured, prior=prior, light=light, on_progress=show)
        lines, exposures = axis.lines(), axis.applied(measured.exposures)
    else:
        tall = heightened(measured)
        with ProgressBar() as bar:
            found = align_views(tall, prior, how, light=illumination.options(), on_progress=bar.show)
        lines, exposures, errors = found.lines(), of_parts(found.exposures, tall, measured), found.errors
        if isinstance(found, AlignedBeams):
            if any(found.sides):
                frames = found.upright(measured.frames)
                missing = None if missing is None else found.upright(missing)
            lasting = lasting if geometry_out is None else found.lasting()
        if table is not None:
            _write_table(table, found)
    put(lines)
    if geometry_out is not None:
        told = errors if errors is None else errors[lasting]
        _write_geometry(geometry_out, scan, reading, (measured.exposures[lasting], exposures[lasting]), told, lines[0])
    same = exposures is measured.exposures
    facts = measured.provenance | {"aligned": lines[0]}
    light = measured.light if frames is measured.source else None  # that of frames which were turned back is not known
    write_scan(out, Scan.of(frames, exposures, measured.is_test, facts, light, missing))
    say(f"wrote {out}: the same {len(measured)} frames, with {'the same' if same else 'other'} exposures")


def _write_geometry(
    path: Path, source: Path, reading: Reading, moved: tuple[Exposures, Exposures], errors: np.ndarray | None, said: str
) -> None:
    """Write the geometry of whole frames; `moved`: exposures before and after, of cut or binned frames of one time."""
    from ..io.beams import Beams, write_beams
    from ..io.formats import read_as

    measured, found = moved
    whole = read_as(source, replace(reading, part=Part(time_frame=reading.part.time_frame)), joined=False).exposures
    whole = whole[: len(found)]
    scales = found.views.relative / measured.views.relative
    shifts = found.views.shifts - scales[:, None] * (measured.views.shifts - whole.views.shifts)
    scales = whole.views.relative * scales
    views = replace(whole.views, rotations=found.views.rotations, shifts=shifts, scales=scales)
    if errors is not None:
        larger = measured.views.pitch / whole.views.pitch
        errors = errors * [larger, larger, 1, 1, 1, 1, 1]
    origin = {"scan": str(source), "aligned": said}
    beams = Beams.of(replace(whole, views=views, distance=found.distance), errors, origin)
    write_beams(path, beams)
    say(f"wrote {path}: the geometry of {len(beams)} beams, for --exposures")


def _write_table(path: Path, found: AlignedViews) -> None:
    """A row for each view."""
    names = (
        "shift_x_px",
        "shift_y_px",
        "turn_x_deg",
        "turn_y_deg",
        "roll_deg",
        "distance_share",
        "magnification_share",
    )
    header = ["view", *names, *(f"error_{name}" for name in names), "flux", "before", "after"]
    last = zip(found.flux, found.before, found.after)
    rows = (
        [v, *(f"{value:.6g}" for value in (*found.changes[v], *found.errors[v], *ends))] for v, ends in enumerate(last)
    )
    write_rows(path, header, rows)


@checked_dataclass
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


@checked_dataclass
class DoubtOptions(PoseFlags):
    """How far off the plan each view may be: standard deviations. 0 keeps it as planned."""

    uncertain_pixel: Share = 0.0
    """Pixel size, as a share of it."""


def calibrate(
    scan: Positional[Path],
    out: Output,
    body: BodyOptions,
    filling: MaterialOptions = MaterialOptions(),
    unknown: DoubtOptions = DoubtOptions(5.0, 2.0, 2.0, 0.05),
    reading: Reading = Reading(),
    *,
    illumination: LightFlags = LightFlags(),
) -> None:
    """Find where beams are by frames of a phantom of known shape, or of beads, for --exposures of other commands.

    Args:
        scan: Scan of the phantom: a file (NXtomo), or a folder.
        out: Geometry to write (TOML).
    """
    from ..align import CalibrationOptions
    from ..align import calibrate as find
    from ..io.beams import Beams, write_beams
    from ..io.formats import read_frames
    from ..matter import MaterialPrior

    require_writable(out)
    whole = reading.part == Part(time_frame=reading.part.time_frame)
    require(whole, "a geometry is that of whole frames; leave --views, --test-views, --crop and --bin.")
    require(filling.material is not None, "calibrate needs the phantom's --material; add it.")
    shape, measured = body.body(), read_frames(scan, reading).in_memory()
    material = filling.filling().of("", measured.exposures.reference_energy)
    with ProgressBar() as bar:
        options, light = CalibrationOptions(unknown.prior(), unknown.uncertain_pixel), illumination.options()
        found = find(measured, MaterialPrior.known(material), shape, options, light=light, on_progress=bar.show)
    put(found.lines())
    beams = Beams.of(found.exposures, found.errors, {"scan": str(scan), "calibrated": found.lines()[0]})
    size, doubt = found.pixel_size
    write_beams(out, beams.with_pixel_size(size) if doubt else beams)
    say(f"wrote {out}: the geometry of {len(measured)} beams, for --exposures")
