"""The pictures and the table of docs/imaging_chain.md: `python docs/figures.py imaging-chain WORK`.

8 generated red cells of 8 µm, 64 × 64 pixels of 0.5 µm, 20 keV, 10 cm, 16 views, 4 of them held out (seed 2). Each case
spoils the scan in one way, reconstructs it with the haemoglobin known, and is judged on the noise-free held-out frames
and on the true volume. What is reconstructed already lies in WORK and is not done again.
"""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np

import holosplat as hs
from holosplat.beamline.misalignment import Misalignment
from holosplat.beamline.record import RecordingOptions, record
from holosplat.beamline.simulate import Simulation, polychromatic_frames, refilled
from holosplat.io.raw_file import FLAT, PROJECTION
from holosplat.io.scan_file import open_scan
from holosplat.optics.camera import Camera, Illumination
from holosplat.optics.coherence import Spectrum, joined_blur_px, source_blur
from holosplat.optics.propagation import poisson
from holosplat.report.style import PanelGrid, image_panel, letter, scale_bar, styled
from holosplat.workflows.correct import CorrectionOptions, correct

DOCS = Path(__file__).parents[1]
SIDE, PIXEL, ENERGY, DISTANCE, PSF, VIEWS, SEED = 64, 0.5e-6, 20.0, 0.1, 0.3, 16, 2
SOURCE = 200e-6, 30.0
"""Standard deviation of the source [m], and its distance [m]: it blurs by 1.3 pixels."""
STEADY = Illumination(0.0, structure=0.0, variation=0.0, components=0, pointing=0.0)
GREY = "gray"


@cache
def scene() -> hs.MeshScene:
    """The cells."""
    width = SIDE * PIXEL
    cells = hs.specimens.random_cells(8, (0.75 * width, 0.85 * width, 0.75 * width), seed=SEED, diameter=16 * PIXEL)
    return hs.MeshScene.of_one_material(cells, hs.materials.HAEMOGLOBIN.delta_beta(ENERGY))


def told(psf_px: float = PSF) -> hs.Exposures:
    """How the frames are said to be taken."""
    return hs.Exposures.of(hs.Views.evenly_spaced(VIEWS, (SIDE, SIDE), PIXEL), ENERGY, DISTANCE, psf_px)


@cache
def ideal() -> hs.Scan:
    """Noise-free frames of a plane wave of one energy."""
    return hs.simulate(scene(), told())


def blurred(known: bool) -> hs.Scan:
    """Frames of a large source, which the reconstruction knows of or not."""
    blur = source_blur(*SOURCE, DISTANCE)
    psf = float(joined_blur_px(PSF, blur, PIXEL))
    scan = hs.simulate(scene(), told(psf))
    return scan if known else replace(scan, exposures=told())


def banded(bandwidth: float) -> hs.Scan:
    """Frames of a Gaussian spectrum, reconstructed as if all had its mean energy."""
    light = Spectrum.gaussian(ENERGY, bandwidth, 5)
    filling = hs.beamline.Filling(hs.materials.HAEMOGLOBIN)
    frames = polychromatic_frames(lambda energy: refilled(scene(), filling, energy), light, told(), Simulation())
    return replace(ideal(), frames=np.stack(list(frames)))


def noisy(photons: float) -> hs.Scan:
    """Frames of Poisson counts."""
    return replace(ideal(), frames=poisson(ideal().frames, photons, SEED))


def recorded(work: Path, light: Illumination, method: CorrectionOptions, scan: hs.Scan | None = None) -> hs.Scan:
    """Frames recorded by the camera under `light`, and corrected."""
    clean, raw, out = (work / f"{name}.nxs" for name in ("clean", "raw", "corrected"))
    hs.io.write_scan(clean, scan or ideal())
    record(clean, raw, RecordingOptions(seed=SEED), Camera(), light, work / "truth.h5")
    correct(raw, out, method)
    return hs.io.read_scan(out)


def misaligned(**errors: float) -> hs.Scan:
    """Frames taken elsewhere than they say."""
    true = Misalignment(**errors, seed=SEED).true_exposures(told())  # type: ignore[arg-type]
    return replace(hs.simulate(scene(), true), exposures=told())


def everything(work: Path) -> hs.Scan:
    """A known source, 1 % bandwidth, camera and pulses, dynamic correction, small errors of alignment."""
    psf = float(joined_blur_px(PSF, source_blur(SOURCE[0] / 2, SOURCE[1], DISTANCE), PIXEL))
    true = Misalignment(0.2, 0.1, 0.005, SEED).true_exposures(told(psf))
    light = Spectrum.gaussian(ENERGY, 0.01, 3)
    filling = hs.beamline.Filling(hs.materials.HAEMOGLOBIN)
    frames = polychromatic_frames(lambda energy: refilled(scene(), filling, energy), light, true, Simulation())
    scan = hs.Scan(np.stack(list(frames)), told(psf), ideal().is_test)
    return recorded(work, Illumination(), CorrectionOptions(), scan)


PLAIN, DYNAMIC = CorrectionOptions("plain"), CorrectionOptions("dynamic")
CASES: dict[str, Callable[[Path], hs.Scan]] = {
    "none": lambda work: ideal(),
    "source of 200 µm at 30 m, known": lambda work: blurred(True),
    "source of 200 µm at 30 m, not known": lambda work: blurred(False),
    "bandwidth 5 %": lambda work: banded(0.05),
    "1000 photons a pixel": lambda work: noisy(1000),
    "camera, steady light, plain": lambda work: recorded(work, STEADY, PLAIN),
    "camera, pulses, plain": lambda work: recorded(work, Illumination(), PLAIN),
    "camera, pulses, plain, mean 1": lambda work: recorded(work, Illumination(), CorrectionOptions("plain", "mean")),
    "camera, pulses, dynamic": lambda work: recorded(work, Illumination(), DYNAMIC),
    "shifts of 0.5 px": lambda work: misaligned(shift_px=0.5),
    "turns of 0.5°": lambda work: misaligned(rotation_deg=0.5),
    "distances off by 5 %": lambda work: misaligned(distance=0.05),
    "all, each smaller": everything,
}
SCORES = ("ssim", "frcm", "dice", "relative_error_delta")


def row(name: str, work: Path, preset: str) -> dict[str, float]:
    """Scores of a case; its slice of δ goes to WORK too."""
    kept = work / f"{list(CASES).index(name):02d}-{preset}"
    if not kept.with_suffix(".json").exists():
        scan, truth = CASES[name](work), scene().voxelise(hs.Grid.of_views(told().views))
        started = time.monotonic()
        prior = hs.MaterialPrior.known(hs.materials.HAEMOGLOBIN.delta_beta(ENERGY))
        result = hs.reconstruct(scan, prior, hs.preset(preset))
        headline = hs.evaluate(result, ideal(), truth).headline()
        np.save(kept.with_suffix(".npy"), result.object.voxelise(truth.grid).delta[:, SIDE // 2])
        kept.with_suffix(".json").write_text(json.dumps({score: headline[score] for score in SCORES}))
        print(f"{name}: {time.monotonic() - started:.0f} s", flush=True)
    return json.loads(kept.with_suffix(".json").read_text())


@styled
def light_picture() -> None:
    """One hologram, spoilt in four ways, and what each changes."""
    view = 2
    shown = {
        "ideal": ideal().frames[view],
        "source 200 µm": blurred(True).frames[view],
        "bandwidth 5 %": banded(0.05).frames[view],
        "1000 photons": noisy(1000).frames[view],
        "distance off by 5 %": hs.simulate(scene(), replace(told(), distance=1.05 * told().distance)).frames[view],
    }
    grid = PanelGrid(2, [1.0] * 5, [1.0] * 5, (4,))
    for column, (name, frame) in enumerate(shown.items()):
        drawn = image_panel(grid.axes[0][column], frame, (PIXEL, PIXEL), GREY, (0.7, 1.4))
        letter(grid.axes[0][column], column, name)
        change = image_panel(grid.axes[1][column], frame - shown["ideal"], (PIXEL, PIXEL), "RdBu_r", (-0.15, 0.15))
    grid.axes[1][0].annotate(
        "less the ideal", (0, 1), (0, 3), textcoords="offset points", xycoords="axes fraction", fontsize=7
    )
    scale_bar(grid.axes[0][0], SIDE * PIXEL)
    grid.bar(drawn, 4, (0, 0), "intensity", "both")
    grid.bar(change, 4, (1, 1), "change", "both")
    save(grid, "light")


@styled
def flat_field_picture(work: Path) -> None:
    """Raw counts, flats and components; plain and dynamic correction, and what they leave."""
    recorded(work, Illumination(), DYNAMIC)
    found = {}
    for name, method in {
        "plain": PLAIN,
        "plain, normalised": CorrectionOptions("plain", "mean"),
        "dynamic": DYNAMIC,
    }.items():
        correct(work / "raw.nxs", work / "corrected.nxs", method)
        found[name] = hs.io.read_scan(work / "corrected.nxs").frames
    clean, view = hs.io.read_scan(work / "clean.nxs").frames, 5
    with open_scan(work / "raw.nxs") as raw, h5py.File(work / "truth.h5") as truth:
        top = {
            "a flat": raw.frame(int(raw.numbers(FLAT)[0])),
            "another": raw.frame(int(raw.numbers(FLAT)[1])),
            "raw projection": raw.frame(int(raw.numbers(PROJECTION)[view])),
        }
        components = [truth["light/components"][k] for k in (0, 6)]
    grid = PanelGrid(2, [1.0] * 5, [1.0] * 5, (2, 4))
    for column, (name, counts) in enumerate(top.items()):
        drawn = image_panel(grid.axes[0][column], counts, (PIXEL, PIXEL), GREY, (0, 3600))
        letter(grid.axes[0][column], column, name)
    for column, (k, component) in enumerate(zip((1, 7), components), start=3):
        pattern = image_panel(grid.axes[0][column], component, (PIXEL, PIXEL), "RdBu_r", (-3, 3))
        letter(grid.axes[0][column], column, f"component {k}")
    for column, (name, frames) in enumerate(found.items()):
        left = image_panel(grid.axes[1][column], frames[view], (PIXEL, PIXEL), GREY, (0.7, 1.4))
        letter(grid.axes[1][column], 5 + column, name)
    for column, (name, panel) in enumerate({"plain, normalised": "g", "dynamic": "h"}.items(), start=3):
        off = image_panel(grid.axes[1][column], found[name][view] - clean[view], (PIXEL, PIXEL), "RdBu_r", (-0.2, 0.2))
        letter(grid.axes[1][column], 5 + column, f"{panel} less the ideal")
    grid.bar(drawn, 2, (0, 0), "counts")
    grid.bar(pattern, 4, (0, 0), "relative")
    grid.bar(left, 2, (1, 1), "intensity", "both")
    grid.bar(off, 4, (1, 1), "residual", "both")
    save(grid, "flat_fields")


@styled
def slices_picture(work: Path, preset: str) -> None:
    """Slices of δ across the axis: the truth, and what was reconstructed of each case."""
    truth = scene().voxelise(hs.Grid.of_views(told().views)).delta[:, SIDE // 2]
    shown = {"truth": truth}
    shown |= {name: np.load(work / f"{number:02d}-{preset}.npy") for number, name in enumerate(CASES)}
    columns = 5
    rows = -(-len(shown) // columns)
    grid = PanelGrid(rows, [1.0] * columns, [1.0] * columns, (columns - 1,))
    short = {"none": "ideal", "source of 200 µm at 30 m, known": "source, known", "all, each smaller": "all, smaller"}
    short |= {
        "source of 200 µm at 30 m, not known": "source, not known",
        "camera, steady light, plain": "camera, steady",
    }
    short |= {
        "camera, pulses, plain": "pulses, plain",
        "camera, pulses, plain, mean 1": "pulses, plain, mean 1",
        "camera, pulses, dynamic": "pulses, dynamic",
    }
    panels = [axes for line in grid.axes for axes in line]
    for index, (axes, (name, image)) in enumerate(zip(panels, shown.items())):
        drawn = image_panel(axes, 1e7 * image, (PIXEL, PIXEL), "magma", (0, 8))
        letter(axes, index, short.get(name, name))
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    scale_bar(panels[0], SIDE * PIXEL)
    grid.bar(drawn, columns - 1, (0, 0), "δ (10⁻⁷)")
    save(grid, "slices")


def save(grid: PanelGrid, name: str) -> None:
    """The figure as docs/images/imaging_chain/NAME.png."""
    folder = DOCS / "images" / "imaging_chain"
    folder.mkdir(parents=True, exist_ok=True)
    grid.figure.savefig(folder / f"{name}.png", dpi=130, metadata={"Software": None})


def main(work: Path, preset: str = "default") -> None:
    """Pictures first, then one row after another."""
    work.mkdir(parents=True, exist_ok=True)
    light_picture()
    flat_field_picture(work)
    with (DOCS / "data" / "imaging_chain.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("imperfection", "preset", *SCORES))
        for name in CASES:
            scores = row(name, work, preset)
            table.writerow((name, preset, *(f"{scores[score]:.4f}" for score in SCORES)))
            print(f"| {name} |", " | ".join(f"{scores[score]:.3f}" for score in SCORES), "|", flush=True)
    slices_picture(work, preset)
