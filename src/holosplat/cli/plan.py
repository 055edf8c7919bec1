"""`holosplat plan`: what an experiment would see, printed before anything is simulated."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from ..checks import in_range, require
from ..progress import Advance
from ..ranges import Frequency, Grams, Many, Metres, Natural, Photons, Pixels, Positive, Seconds, Signed, Small, ranged
from .options import MaterialOptions
from .places import Output
from .progress import ProgressBar
from .sentence import say

if TYPE_CHECKING:
    from ..mesh import TriangleMesh
    from ..planning.contrast import Setup, Subject
    from ..planning.plan import Plan, Recording, Survey

CELL_DIAMETER = 8e-6
LEVEL = 4
"""Subdivisions of the icosphere behind cells and balls: 5120 triangles."""
SIZE_RANGE_M = (1e-8, 1e-1)
MOST_POINTS = 20_000


@dataclass(frozen=True)
@ranged
class ObjectOptions:
    """The one object to be seen."""

    diameter: Small | None = None
    """Diameter of a red cell [m] (what there is unless --ball or --mesh say otherwise; default: 8e-6)."""
    ball: Small | None = None
    """Or: diameter of a ball [m]."""
    mesh: Path | None = None
    """Or: a closed mesh (VTK file), the beam along its z."""
    length_unit: str = "um"
    """Unit of the mesh file's coordinates."""
    tilt_deg: Signed = 0.0
    """Turn of the object about x, across the beam [degrees]: a red cell is seen face-on at 0 and edge-on at 90."""
    material: str = "haemoglobin"
    """Formula, or a name (holosplat materials lists them: haemoglobin, water, soft tissue, PMMA …)."""
    density: Grams | None = None
    """Its density [g/cm³]; a named one has its own."""
    medium: str | None = None
    """Formula or name of what surrounds it; none means vacuum."""
    medium_density: Grams | None = None
    """The medium's density [g/cm³]."""

    def subject(self) -> Subject:
        """The object that the options name."""
        from ..planning.contrast import Subject

        filling = MaterialOptions(self.material, self.density, self.medium, self.medium_density).filling()
        assert filling.material is not None
        return Subject(self._shape(), filling.material, filling.medium).tilted(self.tilt_deg)

    def _shape(self) -> TriangleMesh:
        from ..io.vtk import read_meshes
        from ..mesh import TriangleMesh
        from ..specimens.red_cells import evans_fung_cell, icosphere
        from ..specimens.repair import closed

        given = sum(option is not None for option in (self.diameter, self.ball, self.mesh))
        require(given <= 1, "give only one of --diameter, --ball and --mesh.")
        if self.mesh is not None:
            meshes = read_meshes([self.mesh], self.length_unit)
            require(len(meshes) == 1, f"--mesh must be one mesh file, but {self.mesh} holds {len(meshes)}; name one.")
            return closed(meshes[0], self.length_unit)
        if self.ball is not None:
            sphere, faces = icosphere(LEVEL)
            radius = 0.5 * in_range("ball diameter", self.ball, *SIZE_RANGE_M, unit="metres")
            return TriangleMesh(radius * sphere, faces, "ball")
        diameter = CELL_DIAMETER if self.diameter is None else self.diameter
        return evans_fung_cell(in_range("cell diameter", diameter, *SIZE_RANGE_M, unit="metres"), LEVEL)

    def name(self) -> str:
        """The object in words."""
        around = f"in {self.medium}" if self.medium else "in vacuum"
        if self.mesh is not None:
            shape = f"mesh {self.mesh.name}"
        elif self.ball is not None:
            shape = f"ball of {1e6 * self.ball:.4g} µm"
        else:
            shape = f"red cell of {1e6 * (self.diameter or CELL_DIAMETER):.4g} µm"
        turned = f", turned by {self.tilt_deg:g}°" if self.tilt_deg else ""
        return f"{shape}{turned}, {self.material} {around}"


@dataclass(frozen=True)
@ranged
class BeamOptions:
    """Beam and detector."""

    energy_kev: Positive = 20.0
    """Photon energy [keV]."""
    distance: Metres = 0.1
    """Effective propagation distance [m]."""
    pixel_size: Small = 3.2e-6
    """Effective pixel size [m]."""
    psf_sigma_px: Pixels = 0.0
    """Standard deviation of the Gaussian point-spread function [pixels]."""
    source_angle: float = 0.0
    """Standard deviation of the source as the object sees it [rad]; it blurs by this times the distance."""


@dataclass(frozen=True)
@ranged
class AcquisitionOptions:
    """What is recorded; what is left out is not printed."""

    photons_per_pixel: Photons = 1000.0
    """Mean photons detected in a pixel without the object."""
    views: Natural = 16
    """Number of views over 180°, taken at the same instant."""
    detector: tuple[Natural, Natural] | None = None
    """Rows and columns of a view [pixels]."""
    frame_rate: Frequency | None = None
    """Frames a second [Hz]."""
    exposure: Seconds | None = None
    """Time with light in a frame, such as a pulse's length [s] (default: the whole frame)."""
    velocity: float | None = None
    """Speed of the object across the beam [m/s]."""
    bit_depth: Natural = 16
    """Bits stored for a pixel."""
    frames: Natural = 1
    """Number of instants recorded."""

    def recording(self) -> Recording:
        """What the options say."""
        from ..planning.plan import Recording

        return Recording(**asdict(self))


@dataclass(frozen=True)
@ranged
class RangeOptions:
    """Where the best distance and energy lie."""

    distance_range: tuple[Metres, Metres] | None = None
    """Shortest and longest distance [m] of a survey."""
    energy_range: tuple[Positive, Positive] | None = None
    """Lowest and highest photon energy [keV] of a survey."""
    points: tuple[Many, Many] = (25, 13)
    """Distances and energies of the survey."""
    out: Output | None = None
    """Picture of the survey to write (.png); its table is written beside it (.csv)."""

    @property
    def wanted(self) -> bool:
        """Whether a range is given."""
        return self.distance_range is not None or self.energy_range is not None

    def check(self) -> None:
        """`InputError` unless ranges and files go together."""
        from ..io.atomic import require_writable
        from ..io.provenance import require_free
        from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV

        if not self.wanted:
            require(self.out is None, "--out needs --distance-range or --energy-range, or both.")
            return
        for name, pair, limits, unit in (
            ("--distance-range", self.distance_range, DISTANCE_RANGE_M, "metres"),
            ("--energy-range", self.energy_range, ENERGY_RANGE_KEV, "keV"),
        ):
            for end in pair or ():
                in_range(name, end, *limits, unit=unit)
            rises = pair is None or pair[0] < pair[1]
            require(rises, f"{name} must be a lower and a higher number of {unit}, but it is {pair}; correct it.")
        enough = min(self.points) >= 2 and self.points[0] * self.points[1] <= MOST_POINTS
        require(enough, f"--points must be at least 2, with a product up to {MOST_POINTS}, but they are {self.points}.")
        if self.out is not None:
            require(self.out.suffix.lower() == ".png", f"--out must name a .png file, but it is {self.out}; rename it.")
            require_writable(self.out)
            require_writable(self.out.with_suffix(".csv"))
            require_free(self.out.with_suffix(".csv"))

    def run(self, subject: Subject, setup: Setup, photons: float, on_progress: Advance) -> Survey:
        """The survey of the ranges: distances in equal ratios, energies in equal steps."""
        import numpy as np

        from ..planning.plan import survey

        distances, energies = [setup.distance], [setup.energy_kev]
        if self.distance_range is not None:
            distances = np.geomspace(*self.distance_range, self.points[0])
        if self.energy_range is not None:
            energies = np.linspace(*self.energy_range, self.points[1])
        return survey(subject, setup, photons, np.asarray(distances), np.asarray(energies), on_progress)


def plan(
    what: ObjectOptions,
    beam: BeamOptions,
    record: AcquisitionOptions,
    ranges: RangeOptions,
    as_json: Annotated[bool, arg(name="json")] = False,
) -> None:
    """Say what an experiment would see, resolve and store, and where its best distance and energy lie.

    Args:
        as_json: Print JSON instead of a table.
    """
    from ..planning.contrast import Setup
    from ..planning.plan import plan as make_plan
    from .plan_text import plan_lines, survey_lines

    ranges.check()
    subject, setup, recording = what.subject(), Setup(**asdict(beam)), record.recording()
    planned = make_plan(subject, setup, recording)
    surveyed = None
    if ranges.wanted:
        with ProgressBar() as bar:
            surveyed = ranges.run(
                subject,
                setup,
                recording.photons_per_pixel,
                lambda fraction: bar.show("surveying", fraction, {}),
            )
    if as_json:
        print(json.dumps(_as_dict(what.name(), setup, recording, planned, surveyed), indent=2, allow_nan=False))
    else:
        print(*plan_lines(what.name(), setup, recording, planned), sep="\n")
        if surveyed is not None:
            print("", *survey_lines(surveyed), sep="\n")
    if surveyed is not None and ranges.out is not None:
        _write(ranges.out, surveyed)
        say(f"wrote {ranges.out} and {ranges.out.with_suffix('.csv')}")


def _as_dict(name: str, setup: Setup, recording: Recording, planned: Plan, surveyed: Survey | None) -> dict[str, Any]:
    """All inputs and results; lengths, times and rates in SI units, energies in keV."""
    found: dict[str, Any] = {
        "object": name,
        "setup": asdict(setup),
        "recording": asdict(recording),
        "plan": {group: _numbers(values) for group, values in asdict(planned).items()},
    }
    if surveyed is not None:
        found["survey"] = {
            "distances_m": surveyed.distances.tolist(),
            "energies_kev": surveyed.energies_kev.tolist(),
            "snr": surveyed.snr.tolist(),
            "spread_m": surveyed.spread.tolist(),
            "table": [_numbers(row) for row in surveyed.table()],
        }
    return found


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    """Values as JSON can hold them: a Fresnel number in contact, which is infinite, as text."""
    from ..metrics.images import json_number

    return {name: json_number(value) if isinstance(value, float) else value for name, value in values.items()}


def _write(path: Path, surveyed: Survey) -> None:
    """The picture and the table of a survey."""
    from ..io.atomic import atomic_path, write_rows
    from ..report.plan import survey_figure  # matplotlib, which most plans need not

    rows = surveyed.table()
    write_rows(path.with_suffix(".csv"), list(rows[0]), ([f"{v:.6g}" for v in row.values()] for row in rows))
    with atomic_path(path) as temporary:
        survey_figure(surveyed).savefig(temporary, format="png", dpi=200, metadata={"Software": None})
