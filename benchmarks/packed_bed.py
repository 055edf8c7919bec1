"""A packed bed in a quartz tube, of 8, 4 and 2 measured views, against its segmentation (docs/notebook/real_data.md).

    python benchmarks/packed_bed.py --data FOLDER --work FOLDER

FOLDER holds packed_bed.zip (`holosplat data list` says where it comes from). Every volume is made by `holosplat
reconstruct`, of frames that `holosplat convert` has brought to intensities without the tube. Rows go to
docs/data/real_data.csv, pictures to docs/images/real_data.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tifffile
import torch
from real_data import PICTURES, command, row, write_rows
from scipy.ndimage import shift

import holosplat as hs
from holosplat.io.objects import read_object
from holosplat.io.samples import sample
from holosplat.metrics import dice
from holosplat.optics.patterns import smooth_modes
from holosplat.projectors.voxels import projector_for

PIXEL, MU = 26.33e-6, 246.06
"""Of the data's own programs: the pixel [m], and µ of the particles at 30 keV [1/m]."""
GREY = "--black 0.277 --white 0.843"
"""Intensities of black and white over that without the object: the grey values were stretched, from 0.1246 to 0.3794 of
a detector that gives 0.45 of the light."""
TUBE = "--tube 3.95e-3:4.45e-3:206.8"
VIEWS = {8: "0,2,3,4,6,8,9,10", 4: "0,3,6,9", 2: "0,6"}
"""Of the twelve files, four of which are copies."""
GLASS = "--matter levels --material SiO2 --density 3.9855"
"""Has the µ of the particles by photoabsorption."""
SETS = {
    "SIRT in [0, 1]": '{"kind": "per-view", "retrieval": "paganin", "tomography": "sirt-nonneg"}',
    "TV in [0, 1]": '{"kind": "holographic-tv"}',
    "and still light": '{"kind": "holographic-tv", "volume": {"still_light": 4, "misfit": 3, "inside": 1.975e-3, '
    '"iterations": 300}}',
}
"""Name in tables → config of the method."""
ORDER = 4


def segmentation(folder: Path) -> np.ndarray:
    """The published segmentation [Z, Y, X], as the frames show it: its columns are x, its rows z reversed."""
    found = tifffile.imread(folder / "3d_sample_1.tiff").astype(bool)
    return np.ascontiguousarray(found.transpose(2, 0, 1)[::-1])


def moved(solid: np.ndarray, by: tuple[int, int, int]) -> np.ndarray:
    """The segmentation moved by whole voxels along (z, y, x)."""
    return shift(solid.astype(np.float32), by, order=0) > 0.5


class Misfit:
    """Line integrals of frames [pixels of path], and what a solid leaves of them unexplained."""

    def __init__(self, scan: hs.Scan) -> None:
        views = hs.Views(scan.views.rotations, scan.views.shifts / PIXEL, scan.views.shape, 1.0)
        self.projector = projector_for(hs.Grid.of_views(views), views)
        self.lines = -torch.log(torch.from_numpy(scan.frames).clamp_min(1e-3)) / (MU * PIXEL)
        self.modes = smooth_modes(scan.views.shape, ORDER)[1:].flatten(1).double()

    def __call__(self, solid: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Relative misfit (rms), the same beside still light, and that light [H, W] in pixels of path."""
        array = self.projector.volume_in(torch.from_numpy(solid.astype(np.float32)))
        predicted = self.projector.lines_out(self.projector.project(array))
        missing = self.lines - predicted
        mean = missing.double().mean(dim=0).flatten()
        found = torch.linalg.lstsq(self.modes.T, mean[:, None]).solution[:, 0] @ self.modes
        light = found.reshape(missing.shape[1:]).float()
        size = float(predicted.square().mean().sqrt())
        left = [float(what.square().mean().sqrt()) / size for what in (missing, missing - light)]
        return left[0], left[1], light.numpy()

    def place(self, solid: np.ndarray) -> tuple[int, int, int]:
        """Where frames, beside still light, show the solid: the move (z, y, x) of least misfit."""
        steps = (-2, -1, 0, 1, 2)
        flat = min((self(moved(solid, (z, 0, x)))[1], z, x) for z in steps for x in steps)
        return min((self(moved(solid, (flat[1], y, flat[2])))[1], (flat[1], y, flat[2])) for y in (-1, 0, 1))[1]


def best_threshold(values: np.ndarray, solid: np.ndarray) -> float:
    """The greatest Dice of any threshold."""
    return max(float(dice(values > level, solid)) for level in np.arange(0.2, 0.85, 0.05))


def picture(slices: dict[str, np.ndarray], lights: dict[str, np.ndarray]) -> None:
    """A slice of each volume, and the light that frames have in common."""
    figure, axes = plt.subplots(1, len(slices), figsize=(2.3 * len(slices), 2.6), layout="constrained")
    for axis, (name, values) in zip(axes, slices.items()):
        axis.imshow(values, cmap="gray", vmin=0, vmax=1)
        axis.set_title(name, fontsize=8)
        axis.set_axis_off()
    figure.savefig(PICTURES / "bed.png", dpi=110)
    plt.close(figure)
    figure, axes = plt.subplots(1, len(lights), figsize=(3.4 * len(lights), 2.7), layout="constrained")
    for axis, (name, values) in zip(axes, lights.items()):
        shown = axis.imshow(np.exp(-MU * PIXEL * values), cmap="gray", vmin=0.75, vmax=1.15)
        axis.set_title(name, fontsize=8)
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes.ravel().tolist(), shrink=0.8, label="light / flat")
    figure.savefig(PICTURES / "bed_light.png", dpi=110)
    plt.close(figure)


def scores(values: np.ndarray, solid: np.ndarray, placed: np.ndarray, misfit: Misfit) -> dict[str, float]:
    """Dice at half, of the segmentation as published and where the frames show it, and what is unexplained."""
    plain, beside, _ = misfit(values)
    return {
        "Dice": float(dice(values > 0.5, solid)),
        "Dice, placed": float(dice(values > 0.5, placed)),
        "Dice, best threshold": best_threshold(values, solid),
        "misfit": plain,
        "misfit beside light": beside,
    }


def main() -> None:
    """Run all numbers of views and methods."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    told = sample("packed-bed")
    fetched = command(f"holosplat data fetch packed-bed --from {given.data.resolve()}", given.work)
    source = next(line for line in fetched.splitlines() if told.inner and told.inner in line and "--files" in line)
    source = source.replace("--white 1 ", "")
    solid, slices, lights, first, placed = segmentation(Path(source.split()[0])), {}, {}, None, None
    for count, views in VIEWS.items():
        file = f"bed{count}.nxs"
        (given.work / file).unlink(missing_ok=True)
        command(f"holosplat convert {source} {GREY} --distance 0 --views {views} {TUBE} {file} --to nxtomo", given.work)
        misfit = Misfit(hs.io.read_scan(given.work / file))
        first = first or misfit
        if placed is None:
            by = misfit.place(solid)
            placed = moved(solid, by)
            for name, what in (("segmentation", solid), ("segmentation, placed", placed)):
                plain, beside, light = misfit(what)
                write_rows(row("packed bed", name, {"misfit": plain, "misfit beside light": beside}, 0.0))
                print(name, by, round(plain, 4), round(beside, 4), flush=True)
            lights["beside the segmentation"], slices["segmentation"] = light, placed[:, 50]
        for number, (name, config) in enumerate(SETS.items()):
            (given.work / "method.json").write_text(config)
            run, began = f"run{count}-{number}-{int(time.time())}", time.perf_counter()
            command(f"holosplat reconstruct {file} {GLASS} --config method.json --out {run}", given.work)
            seconds = time.perf_counter() - began
            values = read_object(given.work / run / "object.h5").values[0].numpy()
            found = scores(values, solid, placed, misfit)
            write_rows(row(f"packed bed, {count} views", name, found, seconds))
            print(count, name, {k: round(v, 4) for k, v in found.items()}, f"{seconds:.0f} s", flush=True)
            if count == 8 or number == 2:
                slices[f"{name}, {count} views"] = values[:, 50]
            if number == 2:
                lights[f"found, {count} views"] = misfit(values)[2]
    picture(slices, lights)


if __name__ == "__main__":
    main()
