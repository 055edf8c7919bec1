"""What the mean of the wave at steep places is worth in simulated frames: rows of docs/data/faces.csv.

    python benchmarks/faces.py      # 5 minutes on one core

Errors (rms over the contrast) of frames without the mean (`plain`: the wave of the mean phase) and with it (`mean`), of
the first and second view. The slab is compared with Fresnel's integrals; kinds of `matter_scenes.py` (small, seed 1, 40
rows) and cells with the plain frame of four times as many samples, which is itself off by some per cent where faces lie
along the beam. Rods and continuous matter are not meshes, and have no such samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import matter_scenes
import numpy as np
import torch
from machine import commit
from rows import write
from scipy.special import fresnel

import holosplat as hs
from holosplat.beamline.simulate import Simulation, _Sharp
from holosplat.model import measure
from holosplat.units import wavenumber
from holosplat_bench.specimens.shapes import box_mesh

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "faces.csv"
FINER = 4


@dataclass(frozen=True)
class Case:
    """A scene, one exposure of it, samples a pixel, and the frame [H, W] that is right."""

    name: str
    scene: hs.MeshScene
    taken: hs.Exposures
    samples: int
    right: np.ndarray

    def row(self, view: int) -> dict[str, object]:
        """The errors of both."""
        found = [measure(obj, self.taken, self.samples, torch.float64)[0].numpy() for obj in (self.scene, self.sharp)]
        plain, mean = (np.linalg.norm(one - self.right) / np.linalg.norm(self.right - 1) for one in found)
        numbers = {"plain": f"{plain:.4f}", "mean": f"{mean:.4f}"}
        return {"scene": self.name, "view": view, "samples": self.samples, **numbers, "commit": commit()}

    @property
    def sharp(self) -> _Sharp:
        """The scene as simulations take it."""
        return _Sharp(self.scene, self.taken)


def slabs() -> Iterator[Case]:
    """Faces along the beam at 6.13 and 5.29 µm from the middle, 20 keV, 0.05 m, pixels of 0.5 µm."""
    shape, pixel, energy, distance, delta, parts = (5, 63), 0.5e-6, 20.0, 0.05, 1e-6, 200
    k = float(wavenumber(energy))
    taken = hs.Exposures.of(hs.Views.from_angles([0.0], shape, pixel), energy, distance)
    x = ((np.arange(shape[1] * parts) + 0.5) / parts - shape[1] / 2) * pixel
    sine, cosine = fresnel(np.sqrt(k / (np.pi * distance)) * (x - np.array([[-6.13e-6], [5.29e-6]])))
    edges = 0.5 + (cosine + 1j * sine) * (1 - 1j) / 2
    for phase in (1.0, 2.0, 4.0):
        half = 0.5 * phase / (k * delta)
        box = box_mesh((-6.13e-6, -1e-4, -half), (5.29e-6, 1e-4, half))
        wave = 1 + (np.exp(-1j * phase) - 1) * (edges[0] - edges[1])
        right = np.broadcast_to((np.abs(wave) ** 2).reshape(shape[1], parts).mean(1), shape)
        for samples in (4, 6, 8, 12):
            scene = hs.MeshScene((box,), (hs.DeltaBeta(delta, 0.0),))
            yield Case(f"slab of {phase:g} rad", scene, taken, samples, right)


def families() -> Iterator[tuple[str, hs.MeshScene, hs.Exposures]]:
    """Scenes of meshes, with two views each."""
    for name in matter_scenes.MATTER:
        _, _, drawn, exposures = matter_scenes.planned(name, "small", 1)
        if isinstance(drawn.scene, hs.MeshScene):
            two = exposures[[0, 1]]
            yield name, drawn.scene, replace(two, views=replace(two.views, shape=(40, 64)))
    for pixel in (0.5e-6, 2e-6):
        views = hs.Views.from_angles([0.0, 30.0], (40, 64), pixel)
        cells = hs.specimens.random_cells(4, box=(24e-6, 18e-6, 24e-6), seed=1)
        scene = hs.MeshScene.of_one_material(cells, hs.materials.HAEMOGLOBIN.delta_beta(20.0))
        yield f"cells, pixels of {1e6 * pixel:g} µm", scene, hs.Exposures.of(views, 20.0, 0.1)


def rows() -> Iterator[dict[str, object]]:
    """All of them."""
    for case in slabs():
        yield case.row(0)
    for name, scene, exposures in families():
        samples = Simulation().samples(exposures)
        for view in range(len(exposures)):
            taken = exposures[[view]]
            right = measure(scene, taken, FINER * samples, torch.float64)[0].numpy()
            yield Case(name, scene, taken, samples, right).row(view)


if __name__ == "__main__":
    torch.set_num_threads(1)
    found = []
    for one in rows():
        print(*one.values(), flush=True)
        found.append(one)
    write(found, PAGE)
