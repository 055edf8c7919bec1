"""holosplat: quantitative 3D maps from a handful of X-ray phase-contrast images.

The names below are the public interface; each is imported from its module when it is first used, so that
`import holosplat` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_WHERE = {
    "checks": ("InputError",),
    "geometry": ("Grid", "Views"),
    "scan": ("Exposures", "Scan", "interleaved_split"),
    "volume": ("LineIntegrals", "Object", "Volume"),
    "mesh": ("TriangleMesh",),
    "materials": ("HAEMOGLOBIN", "PLASMA", "RED_CELL", "WATER", "Compound", "DeltaBeta", "Mixture", "parse_material"),
    "optics.camera": ("Camera",),
    "optics.coherence": ("Spectrum", "effective_geometry", "source_blur"),
    "optics.illumination": ("Illumination",),
    "forward": ("Instrument", "Shutter", "Simulation", "measure", "simulate", "simulated_frames"),
    "specimens.scene": ("MeshScene",),
    "specimens.mesh_series": ("MeshSeries",),
    "specimens.red_cells": ("evans_fung_cell", "random_cells"),
    "specimens.repair": ("closed",),
    "specimens.membrane.model": ("Elasticity", "Membrane"),
    "specimens.membrane.resting": ("resting_cell",),
    "specimens.membrane.tweezers": ("stretch",),
    "specimens.flow.suspension": ("Medium", "Suspension"),
    "representations.gaussians": ("GaussianCloud",),
    "representations.surfaces": ("SurfaceMesh",),
    "io.nxtomo": ("read_scan", "scan_writer", "write_scan"),
    "io.volumes": ("read_volume", "write_volume", "write_voxels"),
    "io.vtk": ("read_meshes", "write_mesh"),
    "io.pvd": ("read_pvd", "write_pvd"),
    "experiments.contrast": ("Setup", "Subject"),
    "experiments.grow": ("Growth", "grow"),
    "experiments.plan": ("Recording", "plan", "survey"),
    "experiments.settings": ("MaterialPrior", "Settings", "preset"),
    "experiments.simulate": ("Filling", "read_scene"),
    "experiments.record": ("RecordingOptions", "record"),
    "experiments.correct": ("CorrectionOptions", "correct"),
    "experiments.join": ("join",),
    "experiments.series": ("SeriesFiles", "Timing", "read_series"),
    "experiments.misalignment": ("Misalignment",),
    "experiments.run_folder": ("RunFolder",),
    "experiments.reconstruct": ("Reconstruction", "load_reconstruction", "reconstruct"),
    "experiments.evaluate": ("Evaluation", "evaluate", "render"),
    "experiments.surfaces": ("SurfaceSettings", "refine_surfaces"),
}
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]


if TYPE_CHECKING:
    from .checks import InputError as InputError
    from .experiments.contrast import Setup as Setup
    from .experiments.contrast import Subject as Subject
    from .experiments.correct import CorrectionOptions as CorrectionOptions
    from .experiments.correct import correct as correct
    from .experiments.evaluate import Evaluation as Evaluation
    from .experiments.evaluate import evaluate as evaluate
    from .experiments.evaluate import render as render
    from .experiments.grow import Growth as Growth
    from .experiments.grow import grow as grow
    from .experiments.join import join as join
    from .experiments.misalignment import Misalignment as Misalignment
    from .experiments.plan import Recording as Recording
    from .experiments.plan import plan as plan
    from .experiments.plan import survey as survey
    from .experiments.reconstruct import Reconstruction as Reconstruction
    from .experiments.reconstruct import load_reconstruction as load_reconstruction
    from .experiments.reconstruct import reconstruct as reconstruct
    from .experiments.record import RecordingOptions as RecordingOptions
    from .experiments.record import record as record
    from .experiments.run_folder import RunFolder as RunFolder
    from .experiments.series import SeriesFiles as SeriesFiles
    from .experiments.series import Timing as Timing
    from .experiments.series import read_series as read_series
    from .experiments.settings import MaterialPrior as MaterialPrior
    from .experiments.settings import Settings as Settings
    from .experiments.settings import preset as preset
    from .experiments.simulate import Filling as Filling
    from .experiments.simulate import read_scene as read_scene
    from .experiments.surfaces import SurfaceSettings as SurfaceSettings
    from .experiments.surfaces import refine_surfaces as refine_surfaces
    from .forward import Instrument as Instrument
    from .forward import Shutter as Shutter
    from .forward import Simulation as Simulation
    from .forward import measure as measure
    from .forward import simulate as simulate
    from .forward import simulated_frames as simulated_frames
    from .geometry import Grid as Grid
    from .geometry import Views as Views
    from .io.nxtomo import read_scan as read_scan
    from .io.nxtomo import scan_writer as scan_writer
    from .io.nxtomo import write_scan as write_scan
    from .io.pvd import read_pvd as read_pvd
    from .io.pvd import write_pvd as write_pvd
    from .io.volumes import read_volume as read_volume
    from .io.volumes import write_volume as write_volume
    from .io.volumes import write_voxels as write_voxels
    from .io.vtk import read_meshes as read_meshes
    from .io.vtk import write_mesh as write_mesh
    from .materials import HAEMOGLOBIN as HAEMOGLOBIN
    from .materials import PLASMA as PLASMA
    from .materials import RED_CELL as RED_CELL
    from .materials import WATER as WATER
    from .materials import Compound as Compound
    from .materials import DeltaBeta as DeltaBeta
    from .materials import Mixture as Mixture
    from .materials import parse_material as parse_material
    from .mesh import TriangleMesh as TriangleMesh
    from .optics.camera import Camera as Camera
    from .optics.coherence import Spectrum as Spectrum
    from .optics.coherence import effective_geometry as effective_geometry
    from .optics.coherence import source_blur as source_blur
    from .optics.illumination import Illumination as Illumination
    from .representations.gaussians import GaussianCloud as GaussianCloud
    from .representations.surfaces import SurfaceMesh as SurfaceMesh
    from .scan import Exposures as Exposures
    from .scan import Scan as Scan
    from .scan import interleaved_split as interleaved_split
    from .specimens.flow.suspension import Medium as Medium
    from .specimens.flow.suspension import Suspension as Suspension
    from .specimens.membrane.model import Elasticity as Elasticity
    from .specimens.membrane.model import Membrane as Membrane
    from .specimens.membrane.resting import resting_cell as resting_cell
    from .specimens.membrane.tweezers import stretch as stretch
    from .specimens.mesh_series import MeshSeries as MeshSeries
    from .specimens.red_cells import evans_fung_cell as evans_fung_cell
    from .specimens.red_cells import random_cells as random_cells
    from .specimens.repair import closed as closed
    from .specimens.scene import MeshScene as MeshScene
    from .volume import LineIntegrals as LineIntegrals
    from .volume import Object as Object
    from .volume import Volume as Volume
