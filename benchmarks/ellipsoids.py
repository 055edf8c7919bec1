"""Ellipsoids as ONIX' simulated set has them, in parallel absorption projections: rows of docs/data/ellipsoids.csv.

    python benchmarks/ellipsoids.py [--kinds apart mixed filled] [--views 4 7 9] [--seeds 1 2 3] [--methods NAME ...]
        [--write]

Of ONIX' set (Zhang et al. 2023) it is told that ellipsoids lie at random inside a cylinder, and not how many, how large
or how dense they are. So there are three kinds of scenes here, from easy to hard. `apart`: 8 to 16 ellipsoids of one
attenuation, with semi-axes of 5 to 14 % of the field's width and turned at random, apart from each other in an empty
cylinder of 94 % of it. `mixed`: each with an attenuation of its own, 0.3 to 1 of the largest, and they may overlap,
where attenuations add up. `filled`: 24 to 40 such ellipsoids, of 0.2 to 0.7, in a cylinder that attenuates by 0.3
itself. There are 64³ voxels. Frames are means over 5 × 5 rays a pixel of exp(-Σ µ l) with the exact chords l of the
rays; no projector of the package has a part in them. Nothing is told of the matter, and there is no noise. Views are
even over 180°, and nine others between them are held out.

psnr: -10 log₁₀ of the mean squared error of µ over all voxels, over the square of the truth's largest µ (as volumes
from 0 to 1 have it); empty: that of an empty volume, which says how hard a scene is; ssim: of slices normal to each of
the three axes, their mean, on that range; held_out: SSIM of the frames held out (`metrics.image_scores`).
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.metrics.images import image_scores, intensity_range, structural_similarity
from holosplat.model import Instrument, Model
from holosplat.units import wavenumber
from holosplat_bench.suite.methods import METHODS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "ellipsoids.csv"
SIDE = 64
"""Pixels of a frame along each edge."""
PIXEL, ENERGY = 1e-6, 12.0
"""[m], [keV]; nothing depends on them but units."""
PATH = 1.0
"""Attenuation µl over the cylinder's radius: a fifth to a half is transmitted at the darkest places."""
RAYS, POINTS = 5, 4
"""Rays along a pixel's edge, and points along a voxel's."""
HELD_OUT = 9
DEFAULT = ("auto", "tikhonov-tv", "voxels-waves", "volume")


@dataclass(frozen=True)
class Ellipsoids:
    """E ellipsoids in a cylinder about y. centres: [E, 3] [m]; inward: [E, 3, 3] takes a point about a centre to the
    unit ball; mu: [E] attenuation [1/m]; radius, height: of the cylinder [m]; filling: its own attenuation [1/m]."""

    centres: np.ndarray
    inward: np.ndarray
    mu: np.ndarray
    radius: float
    height: float
    filling: float

    def chords(self, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Σ µ l [N] along rays through points [N, 3] [m] in a direction [3] normal to y: exact lengths of chords."""
        across = points @ np.cross([0.0, 1.0, 0.0], direction)
        total = self.filling * 2 * np.sqrt(np.maximum(0, self.radius**2 - across**2))
        total *= np.abs(points[:, 1]) <= self.height / 2
        for centre, inward, mu in zip(self.centres, self.inward, self.mu):
            p, d = (points - centre) @ inward.T, inward @ direction
            square, along = d @ d, p @ d
            total += mu * 2 / square * np.sqrt(np.maximum(0, along**2 - square * ((p * p).sum(1) - 1)))
        return total

    def at(self, axes: tuple[np.ndarray, ...]) -> np.ndarray:
        """µ [Z, Y, X] [1/m] at the points of a grid with these coordinates x, y, z [m], ascending."""
        x, y, z = axes
        around = (x**2 + z[:, None, None] ** 2 <= self.radius**2) & (np.abs(y)[:, None] <= self.height / 2)
        total = self.filling * around.astype(np.float32)
        for centre, inward, mu in zip(self.centres, self.inward, self.mu):
            half = np.sqrt((np.linalg.inv(inward) ** 2).sum(1))  # of the box around the ellipsoid
            bounds = zip(axes, centre - half, centre + half)
            box = [slice(*np.searchsorted(axis, [low, high])) for axis, low, high in bounds]
            near = [axis[part] - c for axis, part, c in zip(axes, box, centre)]
            inside = sum(
                (row[0] * near[0] + row[1] * near[1][:, None] + row[2] * near[2][:, None, None]) ** 2 for row in inward
            )
            total[box[2], box[1], box[0]] += mu * (inside <= 1)
        return total


COUNTS = {"apart": (8, 16), "mixed": (8, 16), "filled": (24, 40)}
LEVELS = {"apart": (1.0, 1.0), "mixed": (0.3, 1.0), "filled": (0.2, 0.7)}


def drawn(kind: str, seed: int) -> Ellipsoids:
    """A scene of one of the kinds."""
    rng, width = np.random.default_rng([2023, seed, list(COUNTS).index(kind)]), SIDE * PIXEL
    radius = 0.47 * width
    centres, inward, sizes = list[np.ndarray](), list[np.ndarray](), list[float]()
    low, high = COUNTS[kind]
    wanted = int(rng.integers(low, high + 1))
    while len(centres) < wanted:
        axes = width * rng.uniform(0.05, 0.14, 3)
        size, angle = float(axes.max()), rng.uniform(0, 2 * np.pi)
        away = (radius - size) * np.sqrt(rng.uniform())
        centre = np.array([away * np.cos(angle), rng.uniform(-1, 1) * (radius - size), away * np.sin(angle)])
        apart = all(np.linalg.norm(centre - other) > size + s for other, s in zip(centres, sizes))
        if kind == "apart" and not apart:
            continue
        centres.append(centre)
        sizes.append(size)
        inward.append((np.linalg.qr(rng.normal(size=(3, 3)))[0] / axes).T)
    mu = PATH / radius * rng.uniform(*LEVELS[kind], wanted)
    filling = 0.3 * PATH / radius if kind == "filled" else 0.0
    return Ellipsoids(np.array(centres), np.array(inward), mu, radius, 2 * radius, filling)


def frames_of(scene: Ellipsoids, views: hs.Views) -> np.ndarray:
    """Transmission [V, H, W] float32 in `views`, means over the pixels."""
    h, w = views.shape
    columns, rows = (((np.arange(n * RAYS) + 0.5) / RAYS - n / 2) * views.pixel_size for n in (w, h))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    frames = []
    for rotation, shift in zip(views.rotations, views.shifts):
        lab = np.stack([u.ravel() + shift[0], v.ravel() + shift[1], np.zeros(u.size)], 1)
        fine = np.exp(-scene.chords(lab @ rotation, rotation[2]))  # x_obj = Rᵀ x_lab, and the beam is along z
        frames.append(fine.reshape(h, RAYS, w, RAYS).mean((1, 3)))
    return np.array(frames, dtype=np.float32)


def truth_of(scene: Ellipsoids, grid: Grid) -> np.ndarray:
    """µ [Z, Y, X] [1/m], means over voxels."""
    z, y, x = grid.shape
    fine = scene.at(grid.divided((POINTS, POINTS, POINTS)).axes())
    return fine.reshape(z, POINTS, y, POINTS, x, POINTS).mean((1, 3, 5), dtype=np.float64)


@dataclass(frozen=True)
class Row:
    """As the page's head says."""

    kind: str
    seed: int
    views: int
    method: str
    psnr: float
    empty: float
    ssim: float
    held_out: float
    seconds: float
    machine: str
    commit: str


def measured(scene: Ellipsoids, views: int) -> hs.Scan:
    """Frames for training, even over half a turn, and others held out."""
    even = np.arange(views) * 180 / views
    others = (np.arange(HELD_OUT) + 0.37) * 180 / HELD_OUT
    geometry = hs.Views.from_angles(np.concatenate([even, others]), (SIDE, SIDE), PIXEL)
    is_test = np.arange(views + HELD_OUT) >= views
    return hs.Scan(frames_of(scene, geometry), hs.Exposures.of(geometry, ENERGY, 0.0), is_test)


def scored(scan: hs.Scan, truth: np.ndarray, obj: hs.volume.Object) -> tuple[float, float, float]:
    """PSNR [dB] and SSIM of µ, and SSIM of held-out frames."""
    beta = obj.voxelise(Grid.of_views(scan.views)).beta
    found, peak = 2 * wavenumber(ENERGY) * beta.astype(np.float64), truth.max()
    psnr = -10 * np.log10(np.mean((found - truth) ** 2) / peak**2)
    slices = [
        structural_similarity(a / peak, b / peak)
        for axis in range(3)
        for a, b in zip(np.moveaxis(found, axis, 0), np.moveaxis(truth, axis, 0))
    ]
    test = scan.test()
    with torch.no_grad():
        predicted = Model(obj, Instrument(test.exposures)).frames().numpy()
    scores = image_scores(predicted, test.frames, intensity_range(scan.train().frames))
    return float(psnr), float(np.mean(slices)), float(scores.ssim.mean())


@cache
def setting(kind: str, seed: int, views: int) -> tuple[hs.Scan, np.ndarray]:
    """The frames and the true µ."""
    scene = drawn(kind, seed)
    scan = measured(scene, views)
    return scan, truth_of(scene, Grid.of_views(scan.views))


def row(kind: str, seed: int, views: int, name: str) -> Row:
    """One reconstruction, and its scores."""
    scan, truth = setting(kind, seed, views)
    began = time.perf_counter()
    found = METHODS[name].run(scan.train(), hs.MaterialPrior.unknown(), 0, lambda stage, fraction: None)
    seconds = time.perf_counter() - began
    psnr, ssim, held_out = scored(scan, truth, found)
    empty = float(-10 * np.log10(np.mean(truth**2) / truth.max() ** 2))
    return Row(kind, seed, views, name, psnr, empty, ssim, held_out, seconds, platform.machine(), commit())


def keep(found: Row) -> None:
    """Write a row into the table, in place of an earlier one of the same scene, views and method."""
    new = {name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in asdict(found).items()}
    names = ("kind", "seed", "views", "method")
    others = [each for each in read(PAGE) if [each[name] for name in names] != [new[name] for name in names]]
    write([*others, new], PAGE)


def main() -> None:
    """Run what is asked for, and print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=list(COUNTS), choices=list(COUNTS))
    parser.add_argument("--views", nargs="+", type=int, default=[4, 7, 9])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--methods", nargs="+", default=list(DEFAULT), choices=list(METHODS))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for kind in options.kinds:
        for seed in options.seeds:
            for views in options.views:
                for name in options.methods:
                    found = row(kind, seed, views, name)
                    print(found, flush=True)
                    if options.write:
                        keep(found)


if __name__ == "__main__":
    main()
