"""How well true voxels predict frames of sharp matter, by the samples of the waves: docs/data/voxel_waves.csv.

    python benchmarks/voxel_waves.py [--out FILE]

Three balls of water of 7, 9 and 12 pixels (20 keV, 10 cm, three views of 31 × 42 pixels), of which `simulate` makes the
frames. `smooth` are `BandLimitedVoxels`: lines of pixels as large as a voxel, band-limited between them; `steps` are
strips of parts of voxels, as `VoxelGrid` casts them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import machine, written

import holosplat as hs
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid
from holosplat.materials import parse_material
from holosplat.matter import Matter
from holosplat.methods.cross_validation import predicted_frames
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import BandLimitedVoxels, VoxelGrid
from holosplat.scan import Exposures
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "voxel_waves.csv"
COLUMNS = ("pixel_um", "fringe_samples", "voxels", "samples", "seed", "smooth", "steps", "machine", "commit")
SHAPE = (31, 42)


def rows() -> Iterator[dict[str, object]]:
    """smooth, steps: root mean square of what is left of the frames over their contrast."""
    water = parse_material("water").delta_beta(20.0)
    for pixel in (3.2e-6, 5e-6, 8e-6):
        exposures = Exposures.of(hs.Views.evenly_spaced(3, SHAPE, pixel), 20.0, 0.1)
        for seed in (4, 5):
            balls = packed_balls(pixel * np.array([9.0, 7.0, 12.0]), (SHAPE[0] * pixel,) * 3, seed=seed)
            scene = MeshScene.of_one_material([ball.mesh() for ball in balls], water)
            frames = torch.from_numpy(simulate(scene, exposures).frames)
            for refine, samples in ((1, 1), (1, 2), (1, 4), (1, 8), (2, 2), (2, 4), (2, 8)):
                grid = Grid.of_views(exposures.views, refine)
                filled = torch.from_numpy(scene.voxelise(grid).delta / water.delta).float()[None]
                steps = VoxelGrid(filled, grid, Matter.one(*water))
                smooth = BandLimitedVoxels.of(steps)
                left = (predicted_frames(exposures, one, samples) - frames for one in (smooth, steps))
                shares = [f"{float((one.square().mean() / (frames - 1).square().mean()).sqrt()):.3f}" for one in left]
                told = (f"{1e6 * pixel:g}", fringe_sampling(exposures), refine, samples, seed)
                yield dict(zip(COLUMNS, (*told, *shares, machine(), commit())))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=PAGE)
    written(parser.parse_args().out, COLUMNS, rows())
