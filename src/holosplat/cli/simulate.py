"""`holosplat simulate`: meshes, still or moving, or continuous matter to a scan file, and the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from tyro.conf import Positional

from ..beamline.light import EVEN_LIGHT, UnevenLight
from ..beamline.misalignment import Misalignment
from ..checks import InputError, require
from ..geometry import Grid, Views
from ..io.atomic import require_writable
from ..ranges import checked_dataclass
from ..scan import Exposures
from ..units import number_of
from .options import (
    BeamlineOptions,
    MaterialOptions,
    MeshOptions,
    MisalignmentOptions,
    MotionOptions,
    NoiseOptions,
)
from .places import Output
from .progress import ProgressBar
from .sentence import say, tell
from .specimen import NO_SPECTRUM, SourceOptions, SpecimenOptions

if TYPE_CHECKING:
    from ..beamline.series import Timing
    from ..beamline.simulate import Filling
    from ..specimens.drawn import Drawn, Truth
    from ..specimens.scene import MeshScene
    from ..volume import Object


@checked_dataclass
class TruthOptions:
    """What is also written, for judging."""

    truth: Output | None = None
    """Volume file (as `export --volume`): the true δ and β, of a series at its first time."""
    truth_frames: tuple[int, ...] = ()
    """Series: write the true volume at these times instead, counted from 0, to TRUTH_t0000.h5 and so on."""
    truth_regions: bool = False
    """Also write the named parts of matter that may fill the field, as TRUTH_bubbles.h5 and so on (shares of
    voxels)."""
    truth_mesh: Output | None = None
    """STL file: the surfaces of the truth, where it has them, in micrometres."""
    true_exposures: Output | None = None
    """Scan file: the same frames, with poses and distances as they were, not as --out tells them."""

    def require_usable(self, out: Path) -> None:
        """`InputError` unless all files, `out` among them, can be written."""
        from ..io.formats import volume_format

        require(self.truth is not None or not self.truth_frames, "--truth-frames needs --truth.")
        require(self.truth is not None or not self.truth_regions, "--truth-regions needs --truth.")
        if self.truth_mesh is not None and self.truth_mesh.suffix.lower() != ".stl":
            raise InputError(f"--truth-mesh must be a file whose name ends with .stl, but it is {self.truth_mesh}.")
        if self.truth is not None:
            volume_format(self.truth, "--truth")
        for path in filter(None, (out, self.truth, self.truth_mesh, self.true_exposures)):
            require_writable(path)

    def volumes(self, times: int) -> list[tuple[Path, int]]:
        """Each volume file to write, and the number of its time, one of `times`."""
        from ..io.formats import of_time

        if self.truth is None:
            return []
        for n in self.truth_frames:
            require(0 <= n < times, f"--truth-frames must be times of the scan, 0 to {times - 1}, but {n} is none.")
        named = [(of_time(self.truth, frame), frame) for frame in self.truth_frames]
        return named or [(self.truth, 0)]

    def of_regions(
        self, regions: Mapping[str, Object], volumes: list[tuple[Path, int]]
    ) -> dict[Path, tuple[Object, int]]:
        """The file of each named part of matter, the part, and its time's number; `InputError` without such parts."""
        if not self.truth_regions:
            return {}
        require(len(regions) > 0, "--truth-regions is of matter that may fill the field (--specimen); leave it.")
        every = regions.items()
        return {path.with_stem(f"{path.stem}_{name}"): (one, n) for path, n in volumes for name, one in every}

    def write_mesh(self, matter: object) -> bool:
        """The surfaces of `matter` to the STL file, if one is wanted; `InputError` where there are none."""
        from ..io.solids import write_stl
        from ..specimens.scene import MeshScene

        if self.truth_mesh is None:
            return False
        if not isinstance(matter, MeshScene):
            raise InputError("--truth-mesh needs a still truth of surfaces, but this one has none; leave it.")
        write_stl(self.truth_mesh, matter.meshes)
        return True


MOST_FRAMES = 10**6
"""Frames of a scan, at most: more take hours on the smallest of detectors."""


@dataclass(frozen=True)
class _Specimen:
    """What is imaged at which times [T] of frames [s]; facts for the scan file; regions: named parts; goes_on: beyond
    the field."""

    matter: Truth
    times: np.ndarray
    facts: dict[str, str]
    regions: Mapping[str, Truth] = field(default_factory=dict)
    goes_on: bool = False


@dataclass(frozen=True)
class ExperimentOptions:
    """What an experiment does to frames beside recording them."""

    noise: NoiseOptions = NoiseOptions()
    light: UnevenLight = EVEN_LIGHT
    motion: MotionOptions = MotionOptions()
    misalignment: MisalignmentOptions = MisalignmentOptions()
    source: SourceOptions = SourceOptions()
    backend: Literal["auto", "cpu", "cuda", "reference"] = "cpu"
    """What computes waves and rays through meshes: cuda is a GPU (default: cpu, for the same frames everywhere)."""


def simulate(
    files: Positional[tuple[Path, ...]] = (),
    *,
    beamline: BeamlineOptions,
    out: Output,
    imaged: SpecimenOptions = SpecimenOptions(),
    filling: MaterialOptions = MaterialOptions(),
    experiment: ExperimentOptions = ExperimentOptions(),
    truth: TruthOptions = TruthOptions(),
) -> None:
    """Simulate the holograms of closed meshes, still or moving (--frame-rate), of a volume, or of generated matter.

    Args:
        files: VTK files (.vtk, .vtu, .vtp), one a cell; x, y, z are the object frame's, y is the rotation axis. With
            --frame-rate: numbered snapshots (cell00_000.vtk, cell00_001.vtk …), or one collection (.pvd). Or a volume:
            one file of any format of `export --volume`, or TIFF images. None with --specimen.
        out: Scan file to write (NXtomo).
    """
    from ..backends import resolve
    from ..beamline.series import held_out
    from ..beamline.simulate import Simulation
    from ..planning.acts import of_simulation

    truth.require_usable(out)
    resolve(experiment.backend)  # before anything is read
    motion, source, beamline = experiment.motion, experiment.source, beamline.told()
    require(beamline.exposures is None or not source.cone, "--cone goes with --distance; leave it, or --exposures.")
    from_afar = not beamline.distances or source.source_distance is None
    require(from_afar, "--distances is of parallel light; leave --source-distance, which blurs each of them otherwise.")
    of_source, beamline = source.facts(beamline), source.applied(beamline)
    named = imaged.generated.in_medium(filling)
    views, filled = source.rays(beamline.planned()), named.filling(beamline.medium_index)
    off = experiment.misalignment
    errors = (off.misalign_shift, off.misalign_rotation, off.misalign_distance, off.misalign_seed)
    true_views = Misalignment(*errors, off.misalign_magnification).true_exposures(views)
    with ProgressBar() as bar:
        times = imaged.generated.timing(motion) if imaged.generated.specimen else np.zeros(1)
        generated = imaged.continuous(files, beamline, filled, float(times[-1]))
        if generated is None:
            specimen = _specimen(files, beamline, imaged.meshes, filled, motion.timing(), bar)
        else:
            imaged.meshes.require_static()
            moves = len(times) > 1
            require(moves or motion.frame_rate is None, "--frame-rate is of moving meshes; leave it out.")
            require(source.light(beamline.energy_kev) is None, NO_SPECTRUM)
            specimen = _still(generated, times, imaged, files, beamline)
    times = specimen.times
    count = len(views) * len(times)
    require(
        count <= MOST_FRAMES,
        f"views and times must make at most {MOST_FRAMES} frames, but they make {count}; take fewer of --views or "
        "--frames.",
    )
    recorded = {"shutter": motion.shutter(), "light": experiment.light, "backend": experiment.backend}
    how = Simulation(experiment.noise.photons_per_pixel, experiment.noise.seed, **recorded)
    _say_of_missing_field(specimen, true_views.views, beamline.pixel_size)
    of_poses = motion.hold_out == "views"
    split = beamline.split(len(views)) if of_poses else replace(beamline, distances=()).split(len(times))
    is_test = held_out(split, len(views), len(times), motion.hold_out)
    nominal, true, volumes = views.repeated(times), true_views.repeated(times), truth.volumes(len(times))
    facts = {**how.provenance(true), **specimen.facts, **of_source, "medium": named.medium or "vacuum"}
    if imaged.generated.specimen is not None and named.material is not None:
        facts["material"] = named.material
    regions, targets = truth.of_regions(specimen.regions, volumes), [(out, nominal, facts)]
    if truth.true_exposures:
        targets.append((truth.true_exposures, true, facts | {name: f"{value:g}" for name, value in vars(off).items()}))
    tell("the simulation", of_simulation(true_views, how.samples(true_views), len(true)), out)
    if truth.write_mesh(specimen.matter):
        say(f"wrote {truth.truth_mesh}: the true surfaces")
    _write_frames(targets, is_test, source.frames(specimen.matter, filled, true, how))
    text = f"{number_of(len(true), 'frame')} of {' × '.join(map(str, beamline.detector))} pixels"
    moving = f", at {number_of(len(times), 'time')} from {number_of(len(views), 'view')}" if motion.frame_rate else ""
    say(f"wrote {out}: {text}, {is_test.sum()} of them held out{moving}")
    if truth.true_exposures:
        say(f"wrote {truth.true_exposures}: the same frames, with the exposures as they were")
    for path, frame in volumes:
        _write_truth(path, specimen.matter.at(times[frame]), views.views)
        say(f"wrote {path}: the true volume{f' at {times[frame]:.6g} s' if motion.frame_rate else ''}")
    for path, (region, frame) in regions.items():
        _write_truth(path, region.at(times[frame]), views.views)
        say(f"wrote {path}: the share of each voxel that this part fills")


def _specimen(
    meshes: tuple[Path, ...],
    beamline: BeamlineOptions,
    files: MeshOptions,
    filling: Filling,
    timing: Timing | None,
    bar: ProgressBar,
) -> _Specimen:
    """The bodies of `meshes`: moving, where there is a `timing`."""
    from ..beamline.series import SeriesFiles, read_series
    from ..beamline.simulate import read_scene
    from ..io.paraview import COLLECTION, seeming_snapshots

    if timing is None:
        files.require_static()
        collection = next((path for path in meshes if path.suffix.lower() == COLLECTION), None)
        require(
            collection is None, f"{collection} is a collection of snapshots; give --frame-rate to simulate a series."
        )
        matter = read_scene(meshes, filling, beamline.energy_kev, length_unit=files.length_unit, origin=files.origin)
        if (count := seeming_snapshots(meshes)) > 1:
            say(
                f"warning: the files seem to be {count} snapshots, but they are taken for one still scene, with "
                "all bodies at once; for a series give --frame-rate."
            )
        return _Specimen(matter, np.zeros(1), _facts(matter))
    show = bar.of("reading snapshots")
    told = SeriesFiles(files.length_unit, files.origin, files.snapshot_interval, files.time_unit, files.period)
    series, times = read_series(meshes, filling, beamline.energy_kev, timing, told, show)
    facts = {"frame_rate_hz": f"{timing.frame_rate:g}", "snapshots": str(len(series.snapshots))}
    return _Specimen(series, times, _facts(series.snapshots[0]) | facts)


def _facts(scene: MeshScene) -> dict[str, str]:
    found = sorted({f"delta {m.delta:.6g}, beta {m.beta:.6g}" for m in scene.materials})
    return {"meshes": str(len(scene.meshes)), "materials": "; ".join(found)}


def _still(
    generated: Truth | Drawn,
    times: np.ndarray,
    imaged: SpecimenOptions,
    files: tuple[Path, ...],
    beamline: BeamlineOptions,
) -> _Specimen:
    """A volume, or matter that is generated."""
    from ..specimens.drawn import Drawn

    if imaged.generated.specimen is None:
        said = {"volume": ", ".join(path.name for path in files[:3]) + (" …" if len(files) > 3 else "")}
    else:
        said = imaged.generated.facts(beamline)
    if not isinstance(generated, Drawn):
        return _Specimen(generated, times, said)
    said |= {"specimen_drawn": generated.text}
    return _Specimen(generated.scene, times, said, generated.regions, imaged.generated.matter(beamline).goes_on)


def _say_of_missing_field(specimen: _Specimen, views: Views, pixel_size: float) -> None:
    missing = specimen.matter.missing_field(views)
    if specimen.goes_on:
        say("the matter, or its medium, goes on beyond the field of view; the frames are made with it")
    elif missing > 0:
        say(
            f"warning: the scene reaches {1e6 * missing:.3g} µm ({missing / pixel_size:.3g} pixels) beyond "
            "the detector in at least one view; enlarge --detector, or move --origin."
        )


def _write_frames(
    targets: list[tuple[Path, Exposures, dict[str, str]]], is_test: np.ndarray, frames: Iterator[np.ndarray]
) -> None:
    """Every frame to all `targets`, as it comes."""
    from ..io.nxtomo import scan_writer

    with ProgressBar() as bar, ExitStack() as stack:
        writers = [stack.enter_context(scan_writer(path, e, is_test, facts)) for path, e, facts in targets]
        for n, frame in enumerate(frames):
            for add in writers:
                add(frame)
            bar.show("simulating views", (n + 1) / len(is_test), {})


def _write_truth(path: Path, matter: Object, views: Views) -> None:
    from ..io.formats import write_volume_file

    with ProgressBar() as bar:
        write_volume_file(path, matter, Grid.of_views(views), bar.of("voxels"))
