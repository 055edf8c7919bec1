"""A benchmark of one's own: a case, and a method that keeps what it was given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

import holosplat as hs
from holosplat.matter import Matter
from holosplat.methods import Task
from holosplat.representations.voxels import VoxelGrid
from holosplat.specimens.red_cells import icosphere
from holosplat_bench.declaration import Case
from holosplat_bench.suite.methods import BenchMethod
from holosplat_bench.suite.run import Suite

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
PITCH = 1e-6
RADIUS = 5.0
SHAPES = {"round": (24, 24), "wide": (21, 31)}


def make_case(name: str, seed: int) -> Case:
    """A ball in four training frames and two held out; the seed moves it."""
    vertices, faces = icosphere(3)
    ball = hs.mesh.TriangleMesh(PITCH * (RADIUS * vertices + [0.3 * (seed % 7), 1.0, -2.0]), faces)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(6, SHAPES[name], PITCH), 20.0, 0.02)
    scene = hs.MeshScene.of_one_material([ball], MATERIAL)
    return Case(name, seed, scene, exposures, np.arange(6) % 3 == 2, hs.MaterialPrior.known(MATERIAL))


def voxels(scan: hs.Scan, value: float = 1.0) -> VoxelGrid:
    """A cube of `value` in the middle."""
    grid = hs.Grid.of_views(scan.views)
    values = torch.zeros(1, *grid.shape)
    z, y, x = (n // 2 for n in grid.shape)
    values[0, z - 5 : z + 3, y - 3 : y + 5, x - 4 : x + 4] = value
    return VoxelGrid(values, grid, Matter.one(*MATERIAL))


@dataclass(frozen=True)
class Fake(hs.methods.Method):
    """Options of a method with one stage, without a fit."""

    act: Callable[[Task], hs.volume.Object]
    kind: ClassVar[str] = "fake"
    name: ClassVar[str] = "fake"

    @property
    def wants_levels(self) -> bool:
        return False

    def stages(self) -> tuple[Fake]:
        return (self,)

    def start(self, task: Task, before: object) -> hs.volume.Object:
        return self.act(task)

    def fit(self, task: Task, start: hs.volume.Object) -> None:
        """Nothing is fitted."""


class Recorder:
    """Methods that keep what they were given."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, hs.Scan, hs.MaterialPrior, int]] = []

    def method(self, name: str, act: Callable[[hs.Scan], hs.volume.Object] = voxels) -> BenchMethod:
        def start(task: Task) -> hs.volume.Object:
            task.on_progress("thinking", 0.5)
            self.calls.append((name, task.scan, task.prior, task.seed))
            return act(task.scan)

        return BenchMethod(name, "fakes", f"a fake called {name}", Fake(start))

    @property
    def names(self) -> list[str]:
        return [name for name, *_ in self.calls]


def suite(methods: list[BenchMethod], cases=("round",), seeds=(3,), load=make_case) -> Suite:
    return Suite(cases, seeds, {method.name: method for method in methods}, {}, load)


def fail(error: BaseException) -> Callable[[hs.Scan], hs.volume.Object]:
    def act(scan):
        raise error

    return act
