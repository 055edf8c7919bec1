"""How quality, time and memory grow with the frames: the first case of the suite on finer and finer pixels.

    python benchmarks/sizes.py                       # 64, 128 and 256 pixels across the same field
    python benchmarks/sizes.py --pixels 512          # four minutes, 6 GB

24 generated cells in a field of 410 µm, 20 keV, 10 cm, 12 views for the fit and 4 held out, haemoglobin known, without
noise. Prints a Markdown table. Each size runs in a process of its own, whose peak of memory is told; where that was
reached in the simulation, the table says so.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from machine import commit

import holosplat as hs

FIELD = 128 * 3.2e-6
DIAMETER = 20 * 3.2e-6
MATERIAL = hs.materials.HAEMOGLOBIN.delta_beta(20.0)


def measure(pixels: int, seed: int) -> str:
    """A row of the table."""
    pitch = FIELD / pixels
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(24, (FIELD,) * 3, seed, DIAMETER), MATERIAL)
    views = hs.Views.evenly_spaced(16, (pixels, pixels), pitch)
    scan = hs.simulate(scene, hs.Exposures.of(views, 20.0, 0.1, 0.05), seed=seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.perf_counter()
    result = hs.reconstruct(scan, hs.MaterialPrior.known(MATERIAL), hs.preset("default"), seed)
    seconds = time.perf_counter() - began
    assert isinstance(result.object, hs.representations.GaussianCloud)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = hs.evaluate(result, scan, scene.voxelise(hs.Grid.of_views(views))).headline()
    scores = " | ".join(f"{found[name]:.3f}" for name in ("ssim", "frcm", "dice", "relative_error_delta"))
    times = f"{result.timing['start']:.0f} + {result.timing['fit']:.0f} = {seconds:.0f}"
    memory = f"{max(before, after) / 2**20:.1f}" + ("" if after > before else " (simulation)")
    return f"| {pixels} | {1e6 * pitch:.2g} | {scores} | {len(result.object)} | {times} | {memory} |"


def main() -> None:
    """One process a size, in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--one", action="store_true", help="in this process, without the table's head")
    options = parser.parse_args()
    if options.one:
        print(measure(options.pixels[0], options.seed))
        return
    print(f"commit {commit()}, seed {options.seed}\n")
    print("| pixels | pitch / µm | SSIM | FRCM | Dice | error of δ | Gaussians | start + fit / s | peak / GiB |")
    print("| --- " * 9 + "|", flush=True)
    for pixels in options.pixels:
        subprocess.run(
            [sys.executable, __file__, "--one", "--pixels", str(pixels), "--seed", str(options.seed)], check=True
        )


if __name__ == "__main__":
    main()
