"""holosplat: quantitative 3D maps from a handful of X-ray phase-contrast images.

The names below are the public interface; each is imported from its module when it is first used, so that
`import holosplat` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .version import __version__ as __version__

_WHERE = {
    "checks": ("InputError",),
    "geometry": ("Grid", "Views"),
    "scan": ("Exposures", "Scan", "interleaved_split"),
    "volume": ("LineIntegrals", "Object", "Volume"),
    "mesh": ("TriangleMesh",),
    "materials": ("HAEMOGLOBIN", "PLASMA", "RED_CELL", "WATER", "Compound", "Mixture", "parse_material"),
    "optics.camera": ("Camera",),
    "optics.coherence": ("Spectrum", "effective_geometry", "source_blur"),
    "optics.illumination": ("Illumination",),
    "model": ("Alignment", "Instrument", "LightField", "Model", "measure"),
    "beamline.simulate": ("Shutter", "Simulation", "simulate", "simulated_frames"),
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
    "planning.contrast": ("Setup", "Subject"),
    "beamline.grow": ("Growth", "grow"),
    "planning.plan": ("Recording", "plan", "survey"),
    "matter": ("DeltaBeta", "MaterialPrior", "Matter"),
    "methods": ("METHODS", "Gaussians", "NeuralFields", "PerView", "Surfaces", "Voxels", "refine_surfaces"),
    "methods.presets": ("preset",),
    "beamline.scenes": ("Filling", "read_scene"),
    "beamline.record": ("RecordingOptions", "record"),
    "workflows.correct": ("CorrectionOptions", "correct"),
    "workflows.join": ("join",),
    "beamline.series": ("SeriesFiles", "Timing", "read_series"),
    "beamline.misalignment": ("Misalignment",),
    "workflows.run_folder": ("RunFolder",),
    "workflows.reconstruct": ("Reconstruction", "load_reconstruction", "reconstruct"),
    "workflows.evaluate": ("Evaluation", "evaluate", "render"),
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
    from .beamline.grow import Growth as Growth
    from .beamline.grow import grow as grow
    from .beamline.misalignment import Misalignment as Misalignment
    from .beamline.record import RecordingOptions as RecordingOptions
    from .beamline.record import record as record
    from .beamline.scenes import Filling as Filling
    from .beamline.scenes import read_scene as read_scene
    from .beamline.series import SeriesFiles as SeriesFiles
    from .beamline.series import Timing as Timing
    from .beamline.series import read_series as read_series
    from .beamline.simulate import Shutter as Shutter
    from .beamline.simulate import Simulation as Simulation
    from .beamline.simulate import simulate as simulate
    from .beamline.simulate import simulated_frames as simulated_frames
    from .checks import InputError as InputError
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
    from .materials import Mixture as Mixture
    from .materials import parse_material as parse_material
    from .matter import DeltaBeta as DeltaBeta
    from .matter import MaterialPrior as MaterialPrior
    from .matter import Matter as Matter
    from .mesh import TriangleMesh as TriangleMesh
    from .methods import METHODS as METHODS
    from .methods import Gaussians as Gaussians
    from .methods import NeuralFields as NeuralFields
    from .methods import PerView as PerView
    from .methods import Surfaces as Surfaces
    from .methods import Voxels as Voxels
    from .methods import refine_surfaces as refine_surfaces
    from .methods.presets import preset as preset
    from .model import Alignment as Alignment
    from .model import Instrument as Instrument
    from .model import LightField as LightField
    from .model import Model as Model
    from .model import measure as measure
    from .optics.camera import Camera as Camera
    from .optics.coherence import Spectrum as Spectrum
    from .optics.coherence import effective_geometry as effective_geometry
    from .optics.coherence import source_blur as source_blur
    from .optics.illumination import Illumination as Illumination
    from .planning.contrast import Setup as Setup
    from .planning.contrast import Subject as Subject
    from .planning.plan import Recording as Recording
    from .planning.plan import plan as plan
    from .planning.plan import survey as survey
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
    from .workflows.correct import CorrectionOptions as CorrectionOptions
    from .workflows.correct import correct as correct
    from .workflows.evaluate import Evaluation as Evaluation
    from .workflows.evaluate import evaluate as evaluate
    from .workflows.evaluate import render as render
    from .workflows.join import join as join
    from .workflows.reconstruct import Reconstruction as Reconstruction
    from .workflows.reconstruct import load_reconstruction as load_reconstruction
    from .workflows.reconstruct import reconstruct as reconstruct
    from .workflows.run_folder import RunFolder as RunFolder
