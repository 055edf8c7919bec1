"""Light divided out by air, and what is left of it: the numbers of docs/four_beams.md and a case unlike both others.

    python benchmarks/four_beams.py --work FOLDER

Runs docs/four_beams.sh into the new FOLDER/four_beams, then what the page compares with: the light as `correct` says
it, taken as certain; `--normalise mean`; frames without noise, in the true geometry. The case "edge" has cells that
come near the edges of the field, so that little air is left, in light of 2 % (smooth, another in each frame) and noise
of 5000 photons, as raw counts through `correct`. Rows go to docs/data/four_beams.csv. The capsule is a case of
benchmarks/real_data.py.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import subprocess
import time
from pathlib import Path

import h5py
import numpy as np
from real_data import COMMIT, command
from rows import write

import holosplat as hs
from holosplat.beamline.light import UnevenLight
from holosplat.beamline.simulate import simulate
from holosplat.io.vtk import read_meshes

ROOT = Path(__file__).resolve().parents[1]
TABLE, FIELDS = ROOT / "docs/data/four_beams.csv", ("case", "variant", "measure", "value", "seed", "machine", "commit")
SEED = 5
rows: list[dict[str, object]] = []


def add(case: str, variant: str, values: dict[str, float]) -> None:
    """Rows of one variant; the table is written anew."""
    made_on = {"seed": SEED, "machine": f"{platform.machine()}, one core of two", "commit": COMMIT}
    rows.extend(
        {"case": case, "variant": variant, "measure": k, "value": f"{v:.4g}", **made_on} for k, v in values.items()
    )
    print(case, variant, {k: float(f"{v:.4g}") for k, v in values.items()}, flush=True)
    write(rows, TABLE, FIELDS)


def said(run: Path, volume: float) -> dict[str, float]:
    """What summary.json of a run says: the residual over the noise, the total δ, and that over the true one, by the
    bodies' volume [m³] and the material's δ."""
    summary = json.loads((run / "summary.json").read_text())
    verdict, total = summary["verdict"], summary["total"]
    number = re.search(r"([0-9.]+(?:e[+-]?[0-9]+)?) (?:of it|times the noise)", verdict["words"])
    true = volume * summary["material"]["delta"]
    return {
        "explained": float(verdict["good"]),
        "residual over noise": float(number.group(1)) if number else float("nan"),
        "total (m³)": total["value_m3"],
        "its standard error (m³)": total["standard_error_m3"],
        "total over true": total["value_m3"] / true,
    }


def reconstructed(case: str, variant: str, scan: str, options: str, work: Path, volume: float) -> None:
    """One run, and its rows."""
    out = f"run-{variant.replace(' ', '-')}"
    began = time.perf_counter()
    command(f"holosplat reconstruct {scan} --material haemoglobin {options} --out {out}", work)
    add(case, variant, said(work / out, volume) | {"seconds": time.perf_counter() - began})


def volume_of(meshes: list[hs.mesh.TriangleMesh]) -> float:
    """The volume [m³] of closed meshes, by their signed tetrahedra."""
    corners = [mesh.vertices[mesh.faces] for mesh in meshes]
    return abs(sum(float(np.einsum("fi,fi->", c[:, 0], np.cross(c[:, 1], c[:, 2]))) for c in corners)) / 6


def four_beams(work: Path) -> None:
    """The page's own case."""
    folder = work / "four_beams"
    done = subprocess.run(
        ["sh", str(ROOT / "docs/four_beams.sh"), str(folder)], capture_output=True, text=True, check=True
    )
    for line in (line for line in done.stdout.splitlines() if line.startswith(("planned:", "found:"))):
        name, numbers = line.split(":")
        values = [float(n.strip("px,°%")) for n in re.findall(r"[0-9.]+", numbers)]
        add("geometry", name, dict(zip(("shifts (px)", "turns (°)", "roll (°)", "distance (%)"), values)))
    volume = volume_of(read_meshes(sorted((folder / "cells").glob("*.vtk")), "um"))
    add("four beams", "default", said(folder / "run", volume))
    poses = "--exposures geometry.toml"
    reconstructed("four beams", "air taken as certain", "scan.nxs", f"{poses} --light even", folder, volume)
    for n in (1, 2, 3, 4):
        command(f"holosplat correct raw{n}.nxs --normalise mean --out mean{n}.nxs", folder)
    command("holosplat join mean1.nxs mean2.nxs mean3.nxs mean4.nxs --out mean.nxs", folder)
    reconstructed("four beams", "normalised by means", "mean.nxs", poses, folder, volume)
    command("holosplat join true1.nxs true2.nxs true3.nxs true4.nxs --out true.nxs", folder)
    reconstructed("four beams", "no noise and true geometry", "true.nxs", "", folder, volume)


def edge(work: Path) -> None:
    """Cells that come near the edges, little air, smooth light of each frame and noise, through `correct`."""
    folder = work / "edge"
    folder.mkdir()
    cells = hs.specimens.random_cells(8, (76e-6, 52e-6, 76e-6), SEED, 20e-6)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(12, (56, 80), 1e-6), 20.0, 0.05)
    light = UnevenLight(light_flux=0.9, light_smooth=0.02, light_smooth_px=25.0, light_seed=SEED)
    scene = hs.MeshScene.of_one_material(cells, hs.materials.HAEMOGLOBIN.delta_beta(20.0))
    seen = simulate(scene, exposures, photons_per_pixel=5000, seed=SEED, light=light, is_test=np.zeros(12, dtype=bool))
    counts = 10000 * seen.frames
    with h5py.File(folder / "raw.h5", "w") as file:
        file["exchange/data"], file["exchange/data_white"] = counts, np.full((1, 56, 80), 10000.0)
        file["exchange/data_dark"] = np.zeros((1, 56, 80))
        file.create_dataset("exchange/theta", data=np.arange(12) * 15.0).attrs["units"] = "deg"
    told = "--energy-kev 20 --distance 0.05 --pixel-size 1e-6"
    command(f"holosplat correct raw.h5 {told} --out air.nxs", folder)
    command(f"holosplat correct raw.h5 {told} --normalise none --out none.nxs", folder)
    volume = volume_of(cells)
    reconstructed("edge", "default", "air.nxs", "", folder, volume)
    reconstructed("edge", "air taken as certain", "air.nxs", "--light even", folder, volume)
    reconstructed("edge", "not normalised", "none.nxs", "", folder, volume)


def main() -> None:
    """Run both cases."""
    parser = argparse.ArgumentParser(description="Light divided out by air, and what is left of it.")
    parser.add_argument("--work", type=Path, required=True)
    work = parser.parse_args().work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    four_beams(work)
    edge(work)


if __name__ == "__main__":
    main()
