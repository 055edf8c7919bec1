"""How few triangles do on fine pixels: divided all alike, or only where they bend.

    python benchmarks/triangles.py --csv docs/data/triangles.csv            # every variant, 512² pixels, seed 5
    python benchmarks/triangles.py --pixels 256 --photons 2000 --variants "all divided" "all divided, softer"

The scene of benchmarks/sizes.py. Surfaces are found on coarse pixels as `reconstruct` does it, once, and each variant
takes them to the frames' own pixels. `seconds`: CPU time of the division and the fits there, on one thread; memory and
caches are shared with what else runs.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import rows
import torch
from bent_triangles import divided
from machine import commit
from sizes import DIAMETER, FIELD, MATERIAL, SCORES, machine_of, volume_numbers

import holosplat as hs
from holosplat.methods import Gaussians, SurfaceFit, SurfaceOptions, Task
from holosplat.methods.coarse import CoarseToFine, binned, on_pixels, settled
from holosplat.methods.first_surfaces import first_surfaces
from holosplat.methods.illumination import prepared as lit
from holosplat.methods.method import run_quietly
from holosplat.methods.surface_fit import oversampling, surface_fit
from holosplat.representations import GaussianCloud, SurfaceMesh
from holosplat.representations.isosurface import edge_lengths
from holosplat.workflows.evaluate import score_object


@dataclass(frozen=True)
class Variant:
    """How triangles are made on finer pixels, and fitted.

    edge, last_edge: mean edges [pixels] from which on they are divided, between and on the last pixels
    beside: how far an edge's middle lies beside the surface [pixels] that is divided; 0: all are
    softer: whether the stiffness (λ) or the bending, too, are less on edges longer than a pixel
    steps: on pixels between
    """

    edge: float = 1.5
    last_edge: float = 2.5
    beside: float = 0.0
    softer: tuple[str, ...] = ()
    steps: int = 40


RATE, LAST_STEPS = 0.1, 30
"""Of the fits, as in `CoarseToFine`."""
SOFTER = ("stiffness", "bending")
VARIANTS = {
    "all divided": Variant(),
    "only at the end": Variant(2.0),
    "never": Variant(2.0, 4.0),
    "bent by 0.05 px": Variant(beside=0.05),
    "bent by 0.1 px": Variant(beside=0.1),
    "all divided, 20 steps between": Variant(steps=20),
    "all divided, less stiff": Variant(softer=SOFTER[:1]),
    "all divided, softer": Variant(softer=SOFTER),
    "all divided, softer, 20 steps between": Variant(softer=SOFTER, steps=20),
    "all divided, softer, 10 steps between": Variant(softer=SOFTER, steps=10),
    "only at the end, softer": Variant(2.0, softer=SOFTER),
    "never, softer": Variant(2.0, 4.0, softer=SOFTER),
    "bent by 0.05 px, softer": Variant(beside=0.05, softer=SOFTER),
    "bent by 0.1 px, softer": Variant(beside=0.1, softer=SOFTER),
}


def scene_of(pixels: int, seed: int, photons: float | None) -> tuple[hs.MeshScene, hs.Scan]:
    """The cells of sizes.py, and their frames; photons: a pixel, None without noise."""
    cells = hs.MeshScene.of_one_material(hs.specimens.random_cells(24, (FIELD, FIELD, FIELD), seed, DIAMETER), MATERIAL)
    views = hs.Views.evenly_spaced(16, (pixels, pixels), FIELD / pixels)
    return cells, hs.simulate(cells, hs.Exposures.of(views, 20.0, 0.1, 0.05), photons_per_pixel=photons, seed=seed)


def coarse_start(task: Task, how: CoarseToFine) -> SurfaceMesh:
    """The surfaces on the coarsest pixels, after their steps there."""
    coarse, options = binned(task, how.factor(task.scan.views.shape)), SurfaceOptions()
    (way, *_) = first_surfaces(coarse, Gaussians(), options, _no_gaussians)
    found = way(None)
    if found is None:
        raise ValueError("coarse pixels show no bodies")
    return settled(coarse, found, options, how)


def _no_gaussians(task: Task) -> GaussianCloud:
    raise ValueError("surfaces of coarse pixels come before Gaussians")


def prepared(mesh: SurfaceMesh, pixel: float, edge: float, beside: float) -> SurfaceMesh:
    """`coarse.on_pixels`, or the same by triangles that are divided where they bend by more than `beside`."""
    if not beside:
        return on_pixels(mesh, pixel, edge)
    points, faces = mesh.vertices.numpy() * (mesh.unit_length / pixel), mesh.faces.numpy()
    before = 0
    while len(faces) > before and float(edge_lengths(torch.from_numpy(points), torch.from_numpy(faces)).mean()) > edge:
        before = len(faces)
        points, faces = divided(points, faces, edge, beside)
    return SurfaceMesh(torch.from_numpy(points), torch.from_numpy(faces), pixel, mesh.matter, mesh.lines)


def softer(options: SurfaceFit, start: SurfaceMesh, which: tuple[str, ...]) -> SurfaceFit:
    """The options with λ and the weight of bending as on edges of a pixel, where those of `start` are longer.

    The mean of a vertex' neighbours is h²/4 times the Laplacian away, if edges h are alike: λ reaches as far as λ h²
    does, and Σ |L² x|² is h⁸ times the square of Δ² x, on h⁻² vertices a pixel².
    """
    longer = max(1.0, float(edge_lengths(start.vertices, start.faces).mean()))
    if "bending" in which:
        objective = replace(options.objective, bending=options.objective.bending / longer**6)
        options = replace(options, objective=objective)
    return replace(options, stiffness=options.stiffness / longer**2) if "stiffness" in which else options


def to_fine(task: Task, found: SurfaceMesh, variant: Variant) -> tuple[SurfaceMesh, dict[str, str]]:
    """The surfaces on the frames' own pixels, and for each size of pixels triangles and seconds."""
    factor, told = CoarseToFine().factor(task.scan.views.shape) // 2, dict[str, str]()
    while factor:
        at, began = binned(task, factor), time.process_time()
        limit, steps = (variant.edge, variant.steps) if factor > 1 else (variant.last_edge, LAST_STEPS)
        start = prepared(found, at.scan.views.finest, limit, variant.beside)
        options = SurfaceFit(rate=RATE, schedule=replace(SurfaceFit().schedule, steps=steps))
        options = softer(options, start, variant.softer)
        found = run_quietly(surface_fit(at.scan, start, options, task.seed), lambda share: None, SurfaceMesh)
        told[str(at.scan.views.shape[0])] = f"{len(found.faces)} in {time.process_time() - began:.1f} s"
        factor //= 2
    return found, told


def main() -> None:
    """All variants from one start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--photons", type=float, help="a pixel; without noise unless given")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cells, scan = scene_of(options.pixels, options.seed, options.photons)
    task = lit(Task(scan, hs.MaterialPrior.known(MATERIAL), options.seed))
    start = coarse_start(task, CoarseToFine().of_views(len(scan.train())))
    for name in options.variants:
        began = time.process_time()
        found, told = to_fine(task, start, VARIANTS[name])
        seconds = time.process_time() - began
        scores = score_object(found, scan, None, oversampling(scan.train())).headline()
        scores |= volume_numbers(found, cells, hs.Grid.of_views(scan.views))
        row = {
            "variant": name,
            "pixels": options.pixels,
            "photons": f"{options.photons:g}" if options.photons else "",
            "seed": options.seed,
            "triangles": len(found.faces),
            "seconds": f"{seconds:.1f}",
            **{score: f"{float(scores[score]):.4f}" for score in SCORES},
            "stages": "; ".join(f"{size}²: {what}" for size, what in told.items()),
            "load": f"{os.getloadavg()[0]:.1f}",
            "machine": machine_of("cpu"),
            "commit": commit(),
        }
        print(row, flush=True)
        if options.csv:
            rows.write([*rows.read(options.csv), row], options.csv)


if __name__ == "__main__":
    main()
