"""Measured data of other groups, from raw files to volumes: docs/real_data.md with its numbers and pictures.

    python benchmarks/real_data.py --data FOLDER --work FOLDER [--cases NAME …] [--methods NAME …]

FOLDER holds savu_24737_bin2.npz, tooth_bin2.npz and spider_hair_hologram.tiff (`holosplat data fetch`, or
a folder of one's own); what is absent is skipped, and said to be. Each method gets frames for training, their poses,
and a ratio δ/β or nothing. Rows go to docs/data/real_data.csv (those of other cases and methods stay), pictures to
docs/images/real_data.
"""

from __future__ import annotations

import argparse
import csv
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tifffile

import holosplat as hs
from holosplat.baselines.filtered_backprojection import filtered_backprojection
from holosplat.bench.methods import METHODS
from holosplat.bench.record import source_commit
from holosplat.metrics import image_scores, intensity_range
from holosplat.model import measure
from holosplat.projectors.voxels import voxel_line_integrals
from holosplat.volume import Object
from holosplat.workflows.evaluate import score_object

ROOT = Path(__file__).resolve().parents[1]
TABLE, PICTURES = ROOT / "docs/data/real_data.csv", ROOT / "docs/images/real_data"
FIELDS = ("case", "method", "measure", "value", "seconds", "machine", "commit")
OPPONENTS = ("paganin-fbp", "paganin-sirt-nonneg", "paganin-tv-nonneg")
OURS = ("holographic-tv", "gaussians", "volume", "auto")
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
    old = []
    if TABLE.is_file():
        with TABLE.open(newline="", encoding="utf-8") as file:
            old = list(csv.DictReader(file))
    new = {(row["case"], row["method"], row["measure"]) for row in rows}
    kept = [row for row in old if (row["case"], row["method"], row["measure"]) not in new]
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*kept, *rows])


def row(case: str, method: str, scores: dict[str, float], seconds: float) -> list[dict[str, object]]:
    """One row of the table a score."""
    common = {
        "seconds": f"{seconds:.1f}",
        "machine": f"{platform.machine()}, one core of two",
        "commit": source_commit(),
    }
    return [{"case": case, "method": method, "measure": k, "value": f"{v:.4f}", **common} for k, v in scores.items()]


def exchange_file(path: Path, counts: np.ndarray, flats: np.ndarray, darks: np.ndarray, angles: np.ndarray) -> None:
    """Raw counts as a data-exchange file (HDF5), as beamlines write it."""
    with h5py.File(path, "w") as file:
        file["exchange/data"], file["exchange/data_white"], file["exchange/data_dark"] = counts, flats, darks
        file.create_dataset("exchange/theta", data=angles).attrs["units"] = "deg"


def back_projected(scan: hs.Scan, measured: np.ndarray) -> hs.Volume:
    """Filtered back-projection of line integrals of β, `-ln I / 2k`, [V, H, W], of every frame of `scan`."""
    import torch

    grid = hs.Grid.of_views(scan.views)
    beta = filtered_backprojection(
        torch.from_numpy(measured).float(), scan.views, grid, None, lambda done: None
    ).numpy()
    return hs.Volume(np.zeros_like(beta), beta, grid)


def split(scan: hs.Scan, train: np.ndarray) -> hs.Scan:
    """The scan with the frames `train` for training and all others held out."""
    is_test = np.ones(len(scan), dtype=bool)
    is_test[train] = False
    return replace(scan, is_test=is_test)


@dataclass(frozen=True)
class Against:
    """What a volume of few views is held against: `reference` of all views, inside `mask`."""

    reference: hs.Volume
    mask: np.ndarray

    def scores(self, found: hs.Volume) -> dict[str, float]:
        """Correlation of β and its slope (least squares through 0), over the mask."""
        a, b = found.beta[self.mask].astype(float), self.reference.beta[self.mask].astype(float)
        return {"correlation": float(np.corrcoef(a, b)[0, 1]), "slope": float(a @ b / (b @ b))}


Found = dict[str, hs.Volume]


def held_out(made: Object, scan: hs.Scan, measured: hs.Scan) -> dict[str, float]:
    """SSIM of held-out frames: of `scan`, and of those that were `measured`, in the light that both tell apart."""
    scores = {"held-out SSIM": dict(score_object(made, scan, None, 1).test.mean)["ssim"]}
    if measured is not scan:
        true = measured.test()
        shown = measure(made, true.exposures).detach().numpy() * (true.frames / scan.test().frames)
        scores["held-out SSIM, even"] = scores["held-out SSIM"]
        scores["held-out SSIM"] = image_scores(shown, true.frames, intensity_range(measured.train().frames)).mean[
            "ssim"
        ]
    return scores


def each_method(
    case: str,
    scan: hs.Scan,
    prior: hs.MaterialPrior,
    names: list[str],
    judged: Callable[[hs.Volume], dict[str, float]],
    measured: hs.Scan | None = None,
) -> Found:
    """Run methods on the frames for training; rows into the table; the volumes."""
    found: Found = {}
    for name in names:
        began, cpu = time.perf_counter(), time.process_time()
        try:
            made = METHODS[name].run(scan.train(), prior, 0, lambda stage, fraction: None)
        except hs.InputError as error:
            print(f"{case} {name}: refused: {error}", flush=True)
            continue
        seconds = time.perf_counter() - began
        cpu = time.process_time() - cpu
        volume = made.voxelise(hs.Grid.of_views(scan.views))
        found[name] = volume
        scores = {**held_out(made, scan, measured or scan), **judged(volume), "processor seconds": cpu}
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


def corrected_capsule(data: Path, work: Path, crop: str, out: str) -> hs.Scan:
    """Some rows of the capsule, its air divided out, and what one flat leaves in the same pixels; 12 of 91 views for
    training."""
    raw = np.load(data / "savu_24737_bin2.npz")
    exchange_file(work / "capsule.h5", raw["counts"], raw["flat"][None], raw["dark"][None], raw["angles_deg"])
    command(
        "holosplat correct capsule.h5 --energy-kev 20 --distance 0 --pixel-size 42.92e-6 --axis-column 42.625 "
        f"--sense anticlockwise --rings 5 --crop {crop} --out {out}",
        work,
    )
    return split(hs.io.read_scan(work / out), np.arange(0, 91, 8)[:12])


def evened_capsule(scan: hs.Scan, work: Path, out: str) -> hs.Scan:
    """The same without what the 12 views have in common beside the matter."""
    hs.io.write_scan(work / "split.nxs", scan)
    (work / out).unlink(missing_ok=True)
    command(f"holosplat convert split.nxs {out} --to nxtomo --still-light 0 --delta-beta 500", work)
    return hs.io.read_scan(work / out)


def of_all(scan: hs.Scan) -> tuple[hs.Volume, np.ndarray]:
    """Filtered back-projection of all views, and where it is known [Z, Y, X] bool."""
    reference = back_projected(scan, -np.log(np.clip(scan.frames, 1e-3, None)) / (2 * hs.units.wavenumber(20.0)))
    x, _, z = np.meshgrid(*reference.grid.axes(), indexing="ij")
    return reference, (np.hypot(x, z) < 0.45 * scan.views.width).transpose(2, 1, 0)


def capsule(data: Path, work: Path, names: list[str]) -> None:
    """The soft dome of a gelatine capsule: rows 0 to 27, 12 of 91 views; as corrected, and without still light."""
    measured = corrected_capsule(data, work, "0:28,:", "dome.nxs")
    ceiling("capsule dome", measured)
    even = evened_capsule(measured, work, "even.nxs")
    prior = hs.MaterialPrior.of_ratio(500.0)
    for case, scan in (("capsule dome", measured), ("capsule dome, even", even)):
        reference, inside = of_all(scan)
        found = each_method(case, scan, prior, names, Against(reference, inside).scores, measured)
    slices = {"FBP of all 91 views": reference, **found}
    images = {name: attenuation(volume, 20.0)[:, 21] for name, volume in slices.items()}
    panels(PICTURES / "dome.png", images, len(images), "µ (1/cm)")
    raw = np.load(data / "savu_24737_bin2.npz")
    frames = {
        "divided by the flat": (raw["counts"][0].astype(float) / raw["flat"])[:28],
        "by its air": measured.frames[0],
        "and by still light": even.frames[0],
    }
    panels(PICTURES / "dome_frames.png", frames, 3, same=False)


def more_views(data: Path, work: Path, names: list[str]) -> None:
    """The dome by more of the 91 views, and what the frames' misfit has in common: what bounds held-out SSIM."""
    measured, prior = corrected_capsule(data, work, "0:28,:", "dome.nxs"), hs.MaterialPrior.of_ratio(500.0)
    for step in (8, 4, 2):
        scan = split(measured, np.arange(0, 91, step))
        made = METHODS["volume"].run(scan.train(), prior, 0, lambda stage, fraction: None)
        missing = measured.frames - measure(made, measured.exposures).detach().numpy()
        common = [missing[which].mean(axis=0) for which in (~scan.is_test, scan.is_test)]
        scores = {
            **held_out(made, scan, scan),
            "misfit of held-out frames": float(missing[scan.is_test].std()),
            "the same in all": float(common[1].std()),
            "correlation of that with training": float(np.corrcoef(common[0].ravel(), common[1].ravel())[0, 1]),
        }
        count = int((~scan.is_test).sum())
        write_rows(row(f"capsule dome, {count} views", "volume", scores, 0.0))
        print(count, {name: round(value, 4) for name, value in scores.items()}, flush=True)


def whole_capsule(data: Path, work: Path, names: list[str]) -> None:
    """All rows of the capsule, metal and soft matter side by side: 12 of 91 views."""
    scan = corrected_capsule(data, work, ":,:", "whole.nxs")
    reference, inside = of_all(scan)
    soft = inside.copy()
    soft[:, 28:] = False

    def judged(found: hs.Volume) -> dict[str, float]:
        dome = Against(reference, soft).scores(found)
        return {**Against(reference, inside).scores(found), **{f"{k}, dome": v for k, v in dome.items()}}

    found = each_method("whole capsule", scan, hs.MaterialPrior.of_ratio(500.0), names, judged)
    slices = {"FBP of all 91 views": reference, **found}
    images = {name: attenuation(v, 20.0)[scan.views.shape[1] // 2] for name, v in slices.items()}
    low = {f"{name}, soft": np.clip(image, 0, 2.0) for name, image in images.items()}
    panels(PICTURES / "whole.png", images, len(images), "µ (1/cm)")
    panels(PICTURES / "whole_soft.png", low, len(low), "µ (1/cm)")


def fine_dome(data: Path, work: Path, names: list[str]) -> None:
    """The time that the dome would take as it was recorded, 40 rows of 160 pixels: rows 0 to 19, pixels halved."""
    scan = corrected_capsule(data, work, "0:20,:", "top.nxs")
    views = replace(scan.views, shape=(40, 160), pitch=scan.views.pixel_size / 2)
    exposures = replace(scan.exposures, views=views)
    frames = scan.frames.repeat(2, axis=1).repeat(2, axis=2)
    fine = hs.Scan(frames, exposures, scan.is_test)
    reference, inside = of_all(fine)
    each_method("dome of 40 × 160", fine, hs.MaterialPrior.of_ratio(500.0), names, Against(reference, inside).scores)


def ceiling(case: str, whole: hs.Scan) -> None:
    """Rows that say what noise leaves of held-out SSIM: each frame against the mean of four neighbours in angle, and
    against back-projection of all frames, this one too, projected again."""
    import torch

    frames, train = whole.frames, whole.frames[np.arange(0, len(whole), 8)]
    middle = np.arange(2, len(frames) - 2)
    beside = np.mean([frames[middle + step] for step in (-2, -1, 1, 2)], axis=0)
    line = 2 * hs.units.wavenumber(whole.exposures.reference_energy)
    volume = back_projected(whole, -np.log(np.clip(frames, 1e-3, None)) / line)
    beta = torch.from_numpy(volume.beta)[None]
    again = np.exp(-line * voxel_line_integrals(beta, volume.grid, whole.views, step=0.5)[:, 0].numpy())
    for name, shown, true in (("4 neighbours", beside, frames[middle]), ("FBP of all", again, frames)):
        found = image_scores(shown, true, intensity_range(train)).mean["ssim"]
        write_rows(row(case, name, {"held-out SSIM": found}, 0.0))
        print(case, name, round(found, 4), flush=True)


def tooth(data: Path, work: Path, names: list[str]) -> None:
    """A tooth: two rows, 15 of 181 views."""
    raw = np.load(data / "tooth_bin2.npz")
    exchange_file(work / "tooth.h5", raw["counts"], raw["flats"], raw["darks"], raw["angles_deg"])
    command(
        "holosplat correct tooth.h5 --energy-kev 20 --distance 0 --pixel-size 10e-6 --axis-column 147.25 "
        "--sense anticlockwise --method plain --out tooth.nxs",
        work,
    )
    whole = hs.io.read_scan(work / "tooth.nxs")
    thickness = -np.log(np.clip(whole.frames, 1e-3, None)) / (2 * hs.units.wavenumber(20.0))
    reference = back_projected(whole, thickness)
    x, _, z = np.meshgrid(*reference.grid.axes(), indexing="ij")
    inside = (np.hypot(x, z) < 0.45 * whole.views.width).transpose(2, 1, 0)
    scan = split(whole, np.arange(0, 181, 12)[:15])
    found = each_method("tooth", scan, hs.MaterialPrior.of_ratio(300.0), names, Against(reference, inside).scores)
    slices = {"FBP of all 181 views": reference, **found}
    images = {name: attenuation(volume, 20.0)[:, 0] for name, volume in slices.items()}
    panels(PICTURES / "tooth.png", images, len(images), "µ (1/cm)")


def hair(data: Path, work: Path, names: list[str]) -> None:
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
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--methods", nargs="*", default=[n for n in (*OPPONENTS, *OURS) if n in METHODS])
    wanted = parser.parse_args()
    wanted.work.mkdir(parents=True, exist_ok=True)
    for name in wanted.cases:
        if (wanted.data / NEEDS[name]).is_file():
            CASES[name](wanted.data, wanted.work, wanted.methods)
        else:
            print(f"{name} is skipped: {wanted.data / NEEDS[name]} is absent; fetch it or name another --data")


if __name__ == "__main__":
    main()
