"""Families of scenes, each with matter, light and noise at random, and how a reconstruction of each is judged.

A simulated scene is judged by the relative error of δ: its truth has closed forms, or is a mesh, and waves are sampled
more finely than by any method. A measured one is judged by what no run has seen: true phases of held-out views, or the
held-out frames, beside light that changes smoothly. Of one view the peak phase that others published has to do.
"""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import tifffile
import torch

import holosplat as hs
from holosplat.geometry import Views
from holosplat.model import measure
from holosplat.optics.patterns import smooth_modes
from holosplat.scan import Exposures, Scan
from holosplat.units import wavelength, wavenumber
from holosplat_bench.suite.families import SIMULATED, Scene, log_uniform, told_photons
from holosplat_bench.suite.prepare import MEASURED

LIGHT_ORDER = 2
"""Half waves of the light beside which held-out frames are compared."""


# --- measured -----------------------------------------------------------------------------------------------


def _beside_light(made: hs.workflows.Reconstruction, held_out: Scan) -> float:
    """Relative error of the logarithm of held-out frames, each beside light of its own that changes smoothly."""
    predicted = measure(made.object, held_out.exposures, made.oversample).detach().double().clamp_min(1e-3).log()
    true = torch.from_numpy(held_out.frames).double().clamp_min(1e-3).log()
    modes = smooth_modes((true.shape[1], true.shape[2]), LIGHT_ORDER).flatten(1).double()

    def rest(frames: torch.Tensor) -> torch.Tensor:
        flat = frames.flatten(1).T
        return flat - modes.T @ torch.linalg.lstsq(modes.T, flat).solution

    return float(rest(true - predicted).norm() / rest(true).norm())


@cache
def _unpacked(data: Path) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="hl60-"))
    with tarfile.open(data / "hl60_qlsi_A140.tar.lzma", "r:xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def _hl60(
    fresnel: tuple[float, float], views: tuple[int, ...], photons: tuple[float, float] | None, seed: int, data: Path
) -> Scene:
    """The living cell, on pixels 2 × 2 times larger: phases of held-out views are known."""
    rng, folder = np.random.default_rng([60, seed, int(fresnel[0])]), _unpacked(data)
    distance, count = log_uniform(rng, *fresnel), int(rng.choice(views))
    light = 0.0 if photons is None else log_uniform(rng, *photons)
    out = folder / f"{distance:.1f}-{count}-{light:.0f}"
    told = ["--train", count, "--test", 6, "--fresnel", distance, "--photons", light]
    files = [data / "hl60_holograms.py", folder / "series.h5", folder / "angles.txt", out]
    subprocess.run([sys.executable, *map(str, files + told)], check=True, capture_output=True)
    top, left = (int(n) for n in rng.integers(0, 4, 2))
    rows, columns = slice(top, 70 - int(rng.integers(0, 4))), slice(left, 70 - left)
    scan = hs.io.read_scan(out.with_name(out.name + ".nxs")).in_memory().binned(2).cropped(rows, columns)
    truth = np.load(out.with_name(out.name + ".truth.npz"))
    phase = truth["phase"].astype(np.float64)[int(truth["train"]) :]
    phase = phase.reshape(len(phase), 70, 2, 70, 2).mean((2, 4))[:, rows, columns]

    def error(done: hs.workflows.Reconstruction) -> float:
        views = scan.test().views
        found = wavenumber(8.0) * np.asarray(done.object.project(views)[1].detach(), dtype=np.float64)
        return float(np.linalg.norm(found.reshape(phase.shape) - phase) / np.linalg.norm(phase))

    facts = f"λz {distance / 4:.1f} pixels squared, {told_photons(light or None)}, ratio told"
    return Scene(scan, hs.MaterialPrior.of_ratio(1e5), error, facts)


def _contact(name: str, seed: int, data: Path) -> Scene:
    """A measured case of the benchmark, of other views for training."""
    rng = np.random.default_rng([61, seed, len(name)])
    case = replace(MEASURED[name], folder=data)
    whole, count = case.scan(), int(rng.choice([6, 7, 8]))
    chosen = np.unique((rng.uniform() + np.arange(count)) * len(whole) / count % len(whole)).astype(int)
    rest = np.setdiff1d(np.arange(len(whole)), chosen)[:: max(1, len(whole) // 16)]
    scan = whole[np.concatenate([chosen, rest])].with_split(np.arange(len(chosen) + len(rest)) >= len(chosen))
    return Scene(scan, case.prior, lambda done: _beside_light(done, scan.test()), "in contact, ratio told")


def _bed(seed: int, data: Path) -> Scene:
    """The packed bed: 6 of its 8 directions, on pixels 2 × 2 times larger."""
    from packed_bed import GREY, TUBE, VIEWS
    from real_data import command

    rng, folder = np.random.default_rng([62, seed]), Path(tempfile.mkdtemp(prefix="bed-"))
    said = command(f"holosplat data fetch packed-bed --from {data.resolve()}", folder)
    source = next(line for line in said.splitlines() if "--files" in line).replace("--white 1 ", "")
    told = f"{GREY} --distance 0 --views {VIEWS[8]} {TUBE}"
    command(f"holosplat convert {source} {told} bed.nxs --to nxtomo", folder)
    scan = hs.io.read_scan(folder / "bed.nxs").in_memory().binned(2)
    scan = scan.with_split(np.isin(np.arange(len(scan)), rng.choice(len(scan), 2, replace=False)))
    facts = "in contact, ratio told"
    return Scene(scan, hs.MaterialPrior.of_ratio(300.0), lambda done: _beside_light(done, scan.test()), facts)


def _peak(scan: Scan, published: float, done: hs.workflows.Reconstruction) -> float:
    """How far the peak phase is from what others found, of one view, for which nothing can be held out."""
    lines = np.asarray(done.object.project(scan.views)[1].detach(), dtype=np.float64)
    found = wavenumber(scan.exposures.reference_energy) * float(np.quantile(np.abs(lines), 0.999))
    return abs(found - published) / published


def _hair(seed: int, data: Path) -> Scene:
    """A piece of the spider's hair, at random along it."""
    frame = tifffile.imread(data / "spider_hair_hologram.tiff").astype(np.float32)
    left = int(np.random.default_rng([63, seed]).integers(150, 330))
    frame = frame[136:376, left : left + 120].reshape(120, 2, 60, 2).mean((1, 3))
    exposures = Exposures.of(Views.from_angles([0.0], frame.shape, 209.4e-9), 11.0, 78.88e-3)
    scan = Scan(frame[None], exposures, np.zeros(1, dtype=bool))
    return Scene(scan, hs.MaterialPrior.of_ratio(1000.0), partial(_peak, scan, 1.17), f"from column {left}, ratio told")


RED_CELLS = {"Isotonic_RBC": (136e-6, 1.344, 0.661), "Hypotonic_RBC": (44e-6, 1.333, 0.437)}
RED_CELLS |= {"Hypertonic_RBC": (67e-6, 1.347, 0.626), "M_protocystis": (72e-6, 1.333, 0.552)}
"""Distance from focus [m], index of the medium, and the published phase [rad]."""


def _optical(seed: int, data: Path) -> Scene:
    """An optical hologram of one cell, on pixels 2 × 2 times larger; lengths are scaled to 8 keV, as in `_hl60`."""
    name = list(RED_CELLS)[seed % len(RED_CELLS)]
    distance, index, published = RED_CELLS[name]
    frame = tifffile.imread(data / "rbc_holograms" / f"{name}.tif").astype(np.float32) / 127.5
    frame = frame.reshape(64, 2, 64, 2).mean((1, 3))
    scaled = distance * 0.532e-6 / index / wavelength(8.0)
    exposures = Exposures.of(Views.from_angles([0.0], frame.shape, 1e-6), 8.0, scaled)
    scan = Scan(frame[None], exposures, np.zeros(1, dtype=bool))
    return Scene(scan, hs.MaterialPrior.of_ratio(1e4), partial(_peak, scan, published), f"{name}, ratio told")


@dataclass(frozen=True)
class Measured:
    """file: what must be in the folder of data; draw: the scene that a seed gives of that folder."""

    file: str
    draw: Callable[[int, Path], Scene]


HL60 = "hl60_qlsi_A140.tar.lzma"
USUAL, FEW = (6, 7, 8), (4,)
MEASURED_FAMILIES: Mapping[str, Measured] = {
    "HL60, near": Measured(HL60, partial(_hl60, (15.0, 30.0), USUAL, None)),
    "HL60": Measured(HL60, partial(_hl60, (40.0, 60.0), USUAL, None)),
    "HL60, far": Measured(HL60, partial(_hl60, (90.0, 150.0), USUAL, None)),
    "HL60, photons": Measured(HL60, partial(_hl60, (30.0, 80.0), USUAL, (500.0, 1e4))),
    "HL60, few views": Measured(HL60, partial(_hl60, (41.0, 60.0), FEW, None)),
    "capsule dome": Measured("savu_24737_bin2.npz", partial(_contact, "capsule-dome")),
    "tooth": Measured("tooth_bin2.npz", partial(_contact, "tooth")),
    "packed bed": Measured("packed_bed.zip", _bed),
    "spider hair": Measured("spider_hair_hologram.tiff", _hair),
    "optical holograms": Measured("rbc_holograms", _optical),
}


def scene(name: str, seed: int, data: Path | None) -> Scene | str:
    """The scene of a family that `seed` gives; why it is skipped where its data are absent."""
    if name in SIMULATED:
        return SIMULATED[name].scene(seed, name)
    family = MEASURED_FAMILIES[name]
    if data is None or not (data / family.file).exists():
        return f"{name} is skipped: {family.file} is not in {data or 'any folder of data'}; name it by --data."
    return family.draw(seed, data)
