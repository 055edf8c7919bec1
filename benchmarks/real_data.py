"""Measured data of other groups, from raw files to volumes: docs/notebook/real_data.md with its numbers and pictures.

    python benchmarks/real_data.py --data FOLDER [--cases NAME …] [--methods NAME …]

FOLDER holds savu_24737_bin2.npz, tooth_bin2.npz and spider_hair_hologram.tiff (`holosplat data fetch`, or
a folder of one's own); what is absent is skipped, and said to be. Each method gets frames for training, their poses,
and a ratio δ/β or nothing. Rows go to docs/data/real_data.csv (those of other cases and methods stay), pictures to
docs/images/real_data.
"""

from __future__ import annotations

import argparse
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib
from rows import merge

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tifffile

import holosplat as hs
from holosplat.io.reading import Part
from holosplat.metrics import image_scores, intensity_range
from holosplat.model import measure
from holosplat.optics.background import LightOptions
from holosplat.projectors.voxels import voxel_line_integrals
from holosplat.version import source_commit
from holosplat_bench.suite.methods import METHODS
from holosplat_bench.suite.prepare import MEASURED, agreement, back_projected

ROOT = Path(__file__).resolve().parents[1]
TABLE, PICTURES = ROOT / "docs/data/real_data.csv", ROOT / "docs/images/real_data"
FIELDS = ("case", "method", "measure", "value", "seconds", "machine", "commit")
OPPONENTS = ("paganin-fbp", "paganin-sirt-nonneg", "paganin-tv-nonneg")
OURS = ("holographic-tv", "gaussians", "volume", "auto")
FOUND = LightOptions()
COMMIT = source_commit()
"""Before any row is written, which changes the tree."""
PREFIX = [sys.executable, "-c", "from holosplat.cli import main; main()"]


def command(text: str, cwd: Path) -> str:
    """Run `holosplat …` as the page shows it; what it said."""
    print("$", text, flush=True)
    done = subprocess.run([*PREFIX, *shlex.split(text)[1:]], cwd=cwd, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr.split("\r")[-1]
    if done.returncode != 0:
        raise SystemExit(f"{text}\nfailed: {said}")
    return said


def write_rows(rows: list[dict[str, object]]) -> None:
    """Put rows into the table, in the place of those of the same case, method and measure."""
    merge(rows, TABLE, "case", "method", "measure", columns=FIELDS)


def row(case: str, method: str, scores: dict[str, float], seconds: float) -> list[dict[str, object]]:
    """One row of the table a score."""
    common = {
        "seconds": f"{seconds:.1f}",
        "machine": f"{platform.machine()}, one core of two",
        "commit": COMMIT,
    }
    return [{"case": case, "method": method, "measure": k, "value": f"{v:.4f}", **common} for k, v in scores.items()]


Judge = Callable[[hs.Volume], dict[str, float]]
Found = dict[str, hs.Volume]


def each_method(
    case: str, scan: hs.Scan, prior: hs.MaterialPrior, names: list[str], judged: Judge, light: LightOptions = FOUND
) -> Found:
    """Run methods on the frames for training; rows into the table; the volumes. Held-out frames are compared in the
    light that the run found."""
    found: Found = {}
    for name in names:
        began, cpu = time.perf_counter(), time.process_time()
        try:
            made = hs.reconstruct(scan, prior, method=METHODS[name].options, light=light)
        except hs.InputError as error:
            print(f"{case} {name}: refused: {error}", flush=True)
            continue
        seconds = time.perf_counter() - began
        cpu = time.process_time() - cpu
        volume = made.object.voxelise(hs.Grid.of_views(scan.views))
        found[name] = volume
        seen = hs.evaluate(made, scan, None).headline()
        scores = {"held-out SSIM": seen["ssim"], **judged(volume), "processor seconds": cpu}
        write_rows(row(case, name, scores, seconds))
        print(case, name, {k: round(v, 4) for k, v in scores.items()}, f"{seconds:.0f} s", flush=True)
    return found


def panels(path: Path, images: dict[str, np.ndarray], columns: int, unit: str = "", same: bool = True) -> None:
    """Images in a row or more, on one grey scale."""
    rows = -(-len(images) // columns)
    high, wide = next(iter(images.values())).shape
    size = (2.4 * columns, (2.4 * min(high / wide, 2) + 0.35) * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    low, top = 0.0, max(float(np.quantile(i, 0.998)) for i in images.values())
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, (name, image) in zip(axes.ravel(), images.items()):
        limits = {"vmin": low, "vmax": top} if same else {"vmin": np.quantile(image, 0.002), "vmax": image.max()}
        shown = axis.imshow(image, cmap="gray", **limits)
        axis.set_title(name, fontsize=8)
    if unit:
        figure.colorbar(shown, ax=axes.ravel().tolist(), shrink=0.8, label=unit)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def attenuation(volume: hs.Volume, energy_kev: float) -> np.ndarray:
    """µ = 2kβ [1/cm]."""
    return 2 * hs.units.wavenumber(energy_kev) * volume.beta / 100


def capsule(data: Path, names: list[str]) -> None:
    """The soft dome of a gelatine capsule, 12 of 91 views: by default, and with light as air and one flat say it."""
    case = replace(MEASURED["capsule-dome"], folder=data)
    scan, reference = case.scan(), case.truth()
    ceiling("capsule dome", scan, reference)
    judged = partial(agreement, reference=reference)
    each_method("capsule dome, light taken as certain", scan, case.prior, names, judged, LightOptions("even"))
    found = each_method("capsule dome", scan, case.prior, names, judged)
    slices = {"FBP of all 91 views": reference, **found}
    images = {name: attenuation(volume, 20.0)[:, 21] for name, volume in slices.items()}
    panels(PICTURES / "dome.png", images, len(images), "µ (1/cm)")
    raw = np.load(data / "savu_24737_bin2.npz")
    still = hs.reconstruct(scan, case.prior, method=METHODS["volume"].options).still
    assert still is not None
    frames = {
        "divided by the flat": (raw["counts"][0].astype(float) / raw["flat"])[:28],
        "by its air": scan.frames[0],
        "and by still light": scan.frames[0] / still,
    }
    panels(PICTURES / "dome_frames.png", frames, 3, same=False)


def more_views(data: Path, names: list[str]) -> None:
    """The dome by more of the 91 views, and what the frames' misfit has in common: what bounds held-out SSIM."""
    case = replace(MEASURED["capsule-dome"], folder=data)
    for step in (8, 4, 2):
        scan = replace(case, every=step, count=91).scan()
        made = hs.reconstruct(scan, case.prior, method=METHODS["volume"].options, light=LightOptions("even"))
        missing = scan.frames - measure(made.object, scan.exposures).detach().numpy()
        common = [missing[which].mean(axis=0) for which in (~scan.is_test, scan.is_test)]
        scores = {
            "held-out SSIM": hs.evaluate(made, scan, None).headline()["ssim"],
            "misfit of held-out frames": float(missing[scan.is_test].std()),
            "the same in all": float(common[1].std()),
            "correlation of that with training": float(np.corrcoef(common[0].ravel(), common[1].ravel())[0, 1]),
        }
        count = int((~scan.is_test).sum())
        write_rows(row(f"capsule dome, {count} views", "volume", scores, 0.0))
        print(count, {name: round(value, 4) for name, value in scores.items()}, flush=True)


def whole_capsule(data: Path, names: list[str]) -> None:
    """All rows of the capsule, metal and soft matter side by side: 12 of 91 views."""
    case = replace(MEASURED["capsule"], folder=data)
    scan, reference = case.scan(), case.truth()

    def judged(found: hs.Volume) -> dict[str, float]:
        dome = agreement(found, reference, slice(0, 28))
        return {**agreement(found, reference), **{f"{k}, dome": v for k, v in dome.items()}}

    found = each_method("whole capsule", scan, case.prior, names, judged)
    slices = {"FBP of all 91 views": reference, **found}
    images = {name: attenuation(v, 20.0)[scan.views.shape[1] // 2] for name, v in slices.items()}
    low = {f"{name}, soft": np.clip(image, 0, 2.0) for name, image in images.items()}
    panels(PICTURES / "whole.png", images, len(images), "µ (1/cm)")
    panels(PICTURES / "whole_soft.png", low, len(low), "µ (1/cm)")


def fine_dome(data: Path, names: list[str]) -> None:
    """The time that the dome would take as it was recorded, 40 rows of 160 pixels: rows 0 to 19, pixels halved."""
    case = replace(MEASURED["capsule-dome"], folder=data)
    scan = replace(case, reading=replace(case.reading, part=Part(crop="0:20,:"))).scan()
    views = replace(scan.views, shape=(40, 160), pitch=scan.views.pixel_size / 2)
    frames = scan.frames.repeat(2, axis=1).repeat(2, axis=2)
    fine = hs.Scan(frames, replace(scan.exposures, views=views), scan.is_test)
    reference = back_projected(fine, case.prior)
    each_method("dome of 40 × 160", fine, case.prior, names, partial(agreement, reference=reference))


def ceiling(case: str, whole: hs.Scan, volume: hs.Volume) -> None:
    """Rows that say what noise leaves of held-out SSIM: each frame against the mean of four neighbours in angle, and
    against back-projection of all frames, `volume`, this one too, projected again."""
    import torch

    frames, train = whole.frames, whole.frames[np.arange(0, len(whole), 8)]
    middle = np.arange(2, len(frames) - 2)
    beside = np.mean([frames[middle + step] for step in (-2, -1, 1, 2)], axis=0)
    line = 2 * hs.units.wavenumber(whole.exposures.reference_energy)
    beta = torch.from_numpy(volume.beta)[None]
    again = np.exp(-line * voxel_line_integrals(beta, volume.grid, whole.views, step=0.5)[:, 0].numpy())
    for name, shown, true in (("4 neighbours", beside, frames[middle]), ("FBP of all", again, frames)):
        found = image_scores(shown, true, intensity_range(train)).mean["ssim"]
        write_rows(row(case, name, {"held-out SSIM": found}, 0.0))
        print(case, name, round(found, 4), flush=True)


def tooth(data: Path, names: list[str]) -> None:
    """A tooth: two rows, 15 of 181 views."""
    case = replace(MEASURED["tooth"], folder=data)
    scan, reference = case.scan(), case.truth()
    found = each_method("tooth", scan, case.prior, names, partial(agreement, reference=reference))
    slices = {"FBP of all 181 views": reference, **found}
    images = {name: attenuation(volume, 20.0)[:, 0] for name, volume in slices.items()}
    panels(PICTURES / "tooth.png", images, len(images), "µ (1/cm)")


def hair(data: Path, names: list[str]) -> None:
    """A spider hair: phase of one hologram, by retrievals (`names` are of volumes, and do not matter here)."""
    frame = tifffile.imread(data / "spider_hair_hologram.tiff").astype(np.float64)
    exposures = hs.Exposures.of(hs.Views.from_angles([0.0], frame.shape, 104.7e-9), 11.0, 78.88e-3)
    delta, images = 1e-6, {"hologram": frame}
    for name in ("paganin", "ctf", "tikhonov", "admm"):
        began = time.perf_counter()
        found = hs.retrieve(frame[None].astype(np.float32), exposures, hs.DeltaBeta(delta, delta / 1000), name)
        seconds = time.perf_counter() - began
        phase = found.phase[0].numpy().astype(float)
        air = np.concatenate([phase[:100], phase[-100:]])
        phase -= np.median(air)
        across = float(phase[:, 395:405].mean(1).min())
        scores = {
            "least phase": float(np.quantile(phase, 1e-4)),
            "at column 400": across,
            "background": float(air.std()),
        }
        write_rows(row("spider hair", name, scores, seconds))
        print("spider hair", name, {k: round(v, 3) for k, v in scores.items()}, f"{seconds:.0f} s", flush=True)
        images[name] = phase
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    left.imshow(frame, cmap="gray", vmin=0.7, vmax=1.4)
    left.set_title("one hologram", fontsize=9)
    shown = middle.imshow(images["tikhonov"], cmap="gray", vmin=-1.3, vmax=0.1)
    middle.set_title("phase (rad), Tikhonov with positivity", fontsize=9)
    figure.colorbar(shown, ax=middle, shrink=0.8)
    for name in ("paganin", "ctf", "tikhonov", "admm"):
        along = images[name][:, 395:405].mean(1)
        right.plot(np.arange(100, 400) * 0.1047, along[100:400], label=name, lw=1)
    right.set_xlabel("µm, across the hair at column 400")
    right.set_ylabel("phase (rad)")
    right.legend(fontsize=7)
    for axis in (left, middle):
        axis.set_axis_off()
    PICTURES.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURES / "hair.png", dpi=110)
    plt.close(figure)


CASES = {
    "capsule": capsule,
    "more": more_views,
    "whole": whole_capsule,
    "fine": fine_dome,
    "tooth": tooth,
    "hair": hair,
}
NEEDS = dict.fromkeys(("capsule", "more", "whole", "fine"), "savu_24737_bin2.npz") | {
    "tooth": "tooth_bin2.npz",
    "hair": "spider_hair_hologram.tiff",
}


def main() -> None:
    """Run the cases whose data are there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--methods", nargs="*", default=[n for n in (*OPPONENTS, *OURS) if n in METHODS])
    wanted = parser.parse_args()
    for name in wanted.cases:
        if (wanted.data / NEEDS[name]).is_file():
            CASES[name](wanted.data, wanted.methods)
        else:
            print(f"{name} is skipped: {wanted.data / NEEDS[name]} is absent; fetch it or name another --data")


if __name__ == "__main__":
    main()
