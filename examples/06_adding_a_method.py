"""Adding a method: `python 06_adding_a_method.py`.

A method is a frozen dataclass: its fields are its options, its `kind` is its name, and its stages lead from the
training frames to an Object. The method below adds a threshold to phase retrieval and tomography. As a file in
src/holosplat/methods with a line in `METHODS` it would also be known to the command line; see docs/adding.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import holosplat as hs
from holosplat.methods import Method, Stage, Task
from holosplat.representations import Stored, VoxelGrid


@dataclass(frozen=True)
class Threshold:
    """A stage: every voxel becomes empty or full."""

    level: float
    name: str = "threshold"

    def start(self, task: Task, before: Stored | None) -> Stored:
        """The object of this stage, from the object of the stage before."""
        assert isinstance(before, VoxelGrid)
        return before.with_parameters({"values": (before.values > self.level).to(before.values)})

    def fit(self, task: Task, start: Stored) -> None:
        """The fit of the object to the frames: this stage has none."""


@dataclass(frozen=True)
class Thresholded(Method):
    """Phase retrieval and tomography, then a threshold of the occupancy at `level`."""

    kind: ClassVar[str] = "thresholded"

    level: float = 0.5

    def stages(self) -> Sequence[Stage]:
        """The stages of another method, and one more."""
        return (*hs.methods.PerView("tikhonov", "tv").stages(), Threshold(self.level))


if __name__ == "__main__":
    views = hs.Views.evenly_spaced(12, shape=(48, 48), pixel_size=0.65e-6)
    material = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(4, box=(views.width,) * 3, seed=6), material)
    scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.1))
    for method in (hs.methods.PerView("tikhonov", "tv"), Thresholded()):
        result = hs.reconstruct(scan, hs.MaterialPrior.known(material), method)
        print(
            f"{method.kind}:", *hs.evaluate(result, scan, scene.voxelise(hs.Grid.of_views(views))).lines(), sep="\n  "
        )
