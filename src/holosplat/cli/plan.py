"""`holosplat plan`: what an experiment would see, printed before anything is simulated."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from ..checks import in_range, require
from ..frames import evenly
from ..io.atomic import atomic_path, require_writable, write_rows
from ..io.provenance import require_free
from ..matter import MaterialPrior
from ..mesh import TriangleMesh
from ..planning.contrast import Setup, Subject
from ..planning.plan import Motion, Plan, Recording, Sampling, Storage, Survey, experiment, survey
from ..planning.plan import plan as make_plan
from ..progress import Advance
from ..ranges import Many, Metres, Positive, Signed, Small, checked_dataclass
from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV
from ..units import in_percent
from .options import MaterialOptions, OneMaterial
from .places import Output
from .progress import ProgressBar
from .sentence import say

CELL_DIAMETER = 8e-6
LEVEL = 4
"""Subdivisions of the icosphere behind cells and balls: 5120 triangles."""
SIZE_RANGE_M = (1e-8, 1e-1)
MOST_POINTS = 20_000


@checked_dataclass
class ObjectOptions(OneMaterial):
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

    def subject(self) -> Subject:
        """The object that the options name."""
        from ..materials import Transparent

        filling = MaterialOptions(self.material, self.density, self.medium, self.medium_density).filling()
        assert filling.material is not None
        assert not isinstance(filling.material, Transparent)  # there is no --index
        return Subject(self._shape(), filling.material, filling.medium).tilted(self.tilt_deg)

    def _shape(self) -> TriangleMesh:
        from ..io.vtk import read_meshes
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


@checked_dataclass
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
        distances, energies = [setup.distance], [setup.energy_kev]
        if self.distance_range is not None:
            distances = np.geomspace(*self.distance_range, self.points[0])
        if self.energy_range is not None:
            energies = np.linspace(*self.energy_range, self.points[1])
        return survey(subject, setup, photons, np.asarray(distances), np.asarray(energies), on_progress)


def plan(
    what: ObjectOptions,
    beam: Setup,
    record: Recording,
    ranges: RangeOptions,
    times: Many | None = None,
    as_json: Annotated[bool, arg(name="json")] = False,
) -> None:
    """Say what an experiment would see, resolve and store, and where its best distance and energy lie.

    Nothing is written before the end: after a plan that was stopped, give the same command again.

    Args:
        times: Also simulate and reconstruct it so many times, and say how sure its numbers would be (2 or more), by
            retrieval of all views together with total variation.
        as_json: Print JSON instead of a table.
    """
    ranges.check()
    subject = what.subject()
    planned = make_plan(subject, beam, record)
    surveyed = None
    if ranges.wanted:
        with ProgressBar() as bar:
            surveyed = ranges.run(subject, beam, record.photons_per_pixel, bar.of("surveying"))
    foreseen = None
    if times is not None:
        from ..methods import METHODS
        from ..workflows.preconditions import FEWEST_COLUMNS
        from ..workflows.rehearsal import SIDE, foresee

        scene, exposures, photons = experiment(subject, beam, record, SIDE, FEWEST_COLUMNS)
        prior, method = MaterialPrior.known(subject.contrast(beam.energy_kev)), METHODS["holographic-tv"]
        with ProgressBar() as bar:
            foreseen = foresee(scene, exposures, photons, prior, method, times=times, on_progress=bar.show)
    if as_json:
        found = _as_dict(what.name(), beam, record, planned, surveyed)
        found |= {} if foreseen is None else {"rehearsal": foreseen.as_dict()}
        print(json.dumps(found, indent=2, allow_nan=False))
    else:
        print(*_plan_lines(what.name(), beam, record, planned), sep="\n")
        if surveyed is not None:
            print("", *_survey_lines(surveyed), sep="\n")
        if foreseen is not None:
            print("", *foreseen.intervals(), sep="\n")
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
    from ..report.plan import survey_figure  # matplotlib, which most plans need not

    rows = surveyed.table()
    write_rows(path.with_suffix(".csv"), list(rows[0]), ([f"{v:.6g}" for v in row.values()] for row in rows))
    with atomic_path(path) as temporary:
        survey_figure(surveyed).savefig(temporary, format="png", dpi=200, metadata={"Software": None})


WIDTH = 38
MOST_ROWS = 9
"""Energies that are printed, at most."""


def _plan_lines(name: str, setup: Setup, recording: Recording, plan: Plan) -> list[str]:
    """The plan, one quantity a line; what the recording does not say is left out."""
    blur = f", blur {setup.blur_px:.3g} px (standard deviation)" if setup.blur_px else ""
    head = f"{setup.energy_kev:g} keV, {_length(setup.distance)}, pixels of {_length(setup.pixel_size)}{blur}"
    groups = [_waves(plan), _detection(recording, plan), _sampling(recording, plan.sampling)]
    groups += [_motion(plan.motion), _storage(recording, plan.storage)]
    lines = [name, head]
    for title, rows in groups:
        if rows:
            lines += ["", title, *(f"  {label:{WIDTH}}{value}" for label, value in rows)]
    return lines


Group = tuple[str, list[tuple[str, str]]]


def _waves(plan: Plan) -> Group:
    waves = plan.waves
    fringe = f"{_length(waves.fringe)}, {waves.fringe_px:.3g} px" if waves.fringe else "none: absorption alone"
    fringe += " (finer than two pixels: blurred)" if 0 < waves.fringe_px < 2 else ""
    absorbed = f"{in_percent(abs(waves.absorption))} {'more' if waves.absorption >= 0 else 'less'} than the medium"
    rows = [
        ("Δδ, Δβ", f"{waves.delta:.3g}, {waves.beta:.3g}"),
        ("Fresnel number, object's radius", f"{waves.fresnel_object:.3g}"),
        ("Fresnel number, pixel", f"{waves.fresnel_pixel:.3g}"),
        ("first fringe √(λz)", fringe),
        ("largest phase shift", f"{waves.phase:.3g} rad"),
        ("largest absorption", absorbed),
        ("contrast, least to greatest", f"{waves.contrast_low:+.3g} to {waves.contrast_high:+.3g}"),
        ("contrast, rms over the shadow", f"{waves.contrast_rms:.3g}"),
        ("90 % of the signal lies within", _length(waves.spread)),
    ]
    return "one object", rows


def _detection(recording: Recording, plan: Plan) -> Group:
    found = plan.detection
    rows = [
        (f"signal to noise, {_number(recording.photons_per_pixel)} photons/px", f"{found.snr:.3g}"),
        ("  by its place on the pixels", f"{found.snr_worst:.3g} to {found.snr_best:.3g}, rms {found.snr_rms:.3g}"),
        ("photons/px for signal to noise 5", _number(found.photons)),
        (
            "  by its place on the pixels",
            f"{_number(found.photons_best)} to {_number(found.photons_worst)}, for the mean SNR² "
            f"{_number(found.photons_mean)}",
        ),
    ]
    return "detection in one view (object in the middle of an even detector)", rows


def _sampling(recording: Recording, sampling: Sampling) -> Group:
    views = "1 view" if recording.views == 1 else f"{recording.views} views"
    rows = [
        (f"Crowther limit of {views}, object", _length(sampling.limit_object)),
        ("views that resolve a pixel, object", f"{sampling.views_object}"),
    ]
    if sampling.field is not None and sampling.limit_field is not None:
        width, height = sampling.field
        rows += [
            (f"Crowther limit of {views}, field", _length(sampling.limit_field)),
            ("views that resolve a pixel, field", f"{sampling.views_field}"),
            ("field of view, width × height", f"{_length(width)} × {_length(height)}"),
        ]
    return "tomography over 180°, without prior knowledge", rows


def _motion(motion: Motion) -> Group:
    rows = []
    if motion.blur_px is not None:
        rows.append(("blur in an exposure", f"{motion.blur_px:.3g} px"))
    if motion.step_px is not None:
        rows.append(("path from frame to frame", f"{motion.step_px:.3g} px"))
    if motion.longest_exposure is not None and motion.slowest_rate is not None:
        rows.append(("exposure with a blur of one pixel", _with_unit(motion.longest_exposure, "s")))
        rows.append(("frame rate with a path of one pixel", _with_unit(motion.slowest_rate, "Hz")))
    return "motion", rows


def _storage(recording: Recording, storage: Storage) -> Group:
    rows = []
    if storage.data_rate is not None:
        rows.append(("data rate of all views", _with_unit(storage.data_rate, "B/s")))
    if storage.raw is not None and storage.volume is not None:
        instants = "1 frame" if recording.frames == 1 else f"{recording.frames} frames"
        voxels = " × ".join(str(n) for n in storage.volume)
        rows += [
            (f"raw data of {instants}, all views", _with_unit(storage.raw, "B")),
            ("volume (z × y × x), δ and β", f"{voxels} voxels, {_with_unit(storage.volume_bytes or 0, 'B')}"),
            (f"volumes of {instants}", _with_unit(storage.volumes_bytes or 0, "B")),
        ]
    return "data", rows


def _survey_lines(survey: Survey) -> list[str]:
    """The best distance of several energies, and where the best of all lies."""
    energy, distance = survey.best
    rows, count = survey.table(), len(survey.energies_kev)
    shown = sorted({*evenly(count, MOST_ROWS).tolist(), energy})
    photons = _number(survey.photons_per_pixel)
    lines = [
        f"best distance; signal to noise (SNR) with {photons} photons/px, rms over the places on the pixels;",
        "near: the shortest distance with 90 % of that SNR; within: the circle with 90 % of the signal",
        "     energy   distance       near       SNR  photons/px for 5    fringe     within",
    ]
    for e in shown:
        row = rows[e]
        lengths = [_length(row[key]) for key in ("best_distance_m", "distance_for_90_percent_m", "spread_m")]
        lines.append(
            f"  {row['energy_kev']:>5.4g} keV  {lengths[0]:>9}  {lengths[1]:>9}  {row['snr']:>8.3g}  "
            f"{_number(row['photons_for_5']):>16}  {row['fringe_px']:>5.3g} px  {lengths[2]:>9}"
            + ("  best" if e == energy else "")
        )
    ends = _at_an_end("distance", distance, survey.distances) + _at_an_end("energy", energy, survey.energies_kev)
    return lines + ends


def _at_an_end(name: str, index: int, values: np.ndarray) -> list[str]:
    if len(values) == 1 or 0 < index < len(values) - 1:
        return []
    end = "lower" if index == 0 else "upper"
    return [f"  the best {name} is the {end} end of its range: a wider range may hold a better one"]


def _number(value: float) -> str:
    """A count for people: 1.09e+06 → 1.1e6."""
    if value < 1e4:
        return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def _length(metres: float) -> str:
    return _with_unit(metres, "m")


def _with_unit(value: float, unit: str) -> str:
    """`value` with an SI prefix: 3.2e-6 m → 3.2 µm."""
    prefixes = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T", 15: "P", 18: "E"}
    rounded = float(f"{value:.3g}")
    exponent = 0 if rounded == 0 else int(np.clip(3 * np.floor(np.log10(abs(rounded)) / 3), -12, 18))
    return f"{rounded / 10.0**exponent:.4g} {prefixes[exponent]}{unit}"
