"""Matter that fills the field, or is missing in it: rows of docs/data/matter_scenes.csv.

    python benchmarks/matter_scenes.py --seeds 101                  # all kinds: hours on one core
    python benchmarks/matter_scenes.py --kinds bubbles crack --sizes small --seeds 1
    python benchmarks/matter_scenes.py --summary                    # the table of what is there

Each kind of `holosplat simulate --specimen` that may fill the field (`specimens.MATTER`) is drawn with its usual
materials and parameters, on pixels of 1 µm, at 20 keV and 0.1 m: `large` has 96 × 96 pixels and 12 views without noise,
`small` 64 × 64 pixels and 8 views of 3000 photons a pixel. Runs of each are judged by the true volume:

- `told`: the default of `reconstruct`, told the materials (of a shock: the ratio δ/β of its medium);
- `nothing told`: the same, told nothing;
- `wall told` (cuvette and channel): told the wall and what fills it, and the materials in that; judged by what is in
  the wall alone, bubbles or cells;
- `Paganin, TV`: the textbook, told the first of these materials: Paganin's filter for its contrast, of either sign,
  then total variation of its occupancy between 0 and 1.

Seeds below 100 are for development, those from 101 on for reporting. Rows that are there are not made again.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import machine, read, replaced, shown
from scipy.ndimage import binary_dilation

import holosplat as hs
from holosplat.geometry import Grid, Views
from holosplat.methods import Auto, PerView
from holosplat.metrics import dice, volume_scores
from holosplat.scan import Exposures, Scan
from holosplat.specimens import MeshScene
from holosplat.specimens.drawn import Drawn, Substances
from holosplat.volume import Volume, Wall
from holosplat_bench.specimens.fluids import Cuvette
from holosplat_bench.specimens.matter import MATTER, Changing, FieldMatter
from holosplat_bench.specimens.solids import Channel

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "matter_scenes.csv"
PIXEL, ENERGY, DISTANCE = 1e-6, 20.0, 0.1
SIZES = {"small": (64, 8, 3000.0), "large": (96, 12, None)}
"""Pixels along an edge, views, and photons a pixel."""
BARE = "shock, no bubble"
"""A kind beside those of `MATTER`: a shock about nothing."""
RUNS = ("Paganin, TV", "told", "nothing told", "wall told")
TEXTBOOK = PerView("paganin", "tv")
AROUND = 2
"""Voxels around true holes in which found ones are compared with them."""


@dataclass(frozen=True)
class Row:
    """use: development or reporting; error: relative, of δ; dice: of the voxels beyond half the material's δ; total: of
    δ, over the true one; holes: Dice of voxels below half of it, in true holes and two voxels around (also
    outside of the matter); result: the kind of Object, or why there is none; verdict: whether it is good; seconds: of
    the processor."""

    kind: str
    size: str
    run: str
    seed: int
    use: str
    error: float
    dice: float
    total: float
    holes: float | str
    result: str
    verdict: str
    frames: str
    specimen: str
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Scene:
    """scan: the frames; substances: δ and β of what is in it; drawn: the truth."""

    scan: Scan
    substances: Substances
    drawn: Drawn
    kind: FieldMatter

    def told(self, how: str) -> hs.MaterialPrior:
        """What a run is told: the materials against their medium, or the ratio of a shock's medium, or nothing; the
        textbook the first of the materials."""
        if how == "nothing told":
            return hs.MaterialPrior.unknown()
        if self.kind.kind == "shock":
            return hs.MaterialPrior.of_ratio(self.substances.medium.ratio)
        if how == "wall told":
            return hs.MaterialPrior.known(self.within[1])
        core, first = self.substances.core, self.substances.contrast
        if how == "told" and core is not None:
            return hs.MaterialPrior.known(first, core.against(self.substances.medium))
        return hs.MaterialPrior.known(first)

    @property
    def within(self) -> tuple[str, hs.DeltaBeta]:
        """What is in the filling of the wall: the name of its region, and δ and β against the filling."""
        material, core, medium = self.substances.material, self.substances.core, self.substances.medium
        assert core is not None
        bubbles = "bubbles" in self.drawn.regions
        return ("bubbles", medium.against(core)) if bubbles else ("cells", core.against(material))


def wall_of(kind: Cuvette | Channel, substances: Substances) -> Wall:
    """The glass of a cuvette or of a channel, and what fills it."""
    assert substances.core is not None
    if isinstance(kind, Cuvette):
        inner = kind.size * (1 - 2 * kind.wall)
        return Wall((inner, inner), (kind.size, kind.size), substances.material, substances.core)
    return Wall((kind.size, kind.size * kind.depth), None, substances.medium, substances.material)


def planned(name: str, size: str, seed: int) -> tuple[FieldMatter, Substances, Drawn, Exposures]:
    """The kind of a scene, what is in that which `seed` gives, the scene, and how its frames are taken."""
    pixels, count, _ = SIZES[size]
    of, more = (MATTER["shock"], {"bubble": 0.0}) if name == BARE else (MATTER[name], {})
    kind = of(of.extent * pixels * PIXEL, **more)
    substances = substances_of(kind)
    views = Views.evenly_spaced(count, shape=(pixels, pixels), pixel_size=PIXEL)
    exposures = Exposures.of(views, energy_kev=ENERGY, distance=DISTANCE)
    return kind, substances, kind.drawn(substances, seed), exposures


def scene(name: str, size: str, seed: int) -> Scene:
    """The scene of a kind that `seed` gives, with its frames."""
    kind, substances, drawn, exposures = planned(name, size, seed)
    is_test = np.zeros(len(exposures), dtype=bool)
    scan = hs.simulate(drawn.scene, exposures, photons_per_pixel=SIZES[size][2], seed=seed, is_test=is_test)
    return Scene(scan, substances, drawn, kind)


def substances_of(kind: FieldMatter | Changing) -> Substances:
    """The usual ones of a kind."""
    material, core, medium = (_delta_beta(one) for one in kind.named)
    return Substances(material, None if kind.named[1] is None else core, medium)


def _delta_beta(name: str | None) -> hs.DeltaBeta:
    return hs.materials.parse_material(name).delta_beta(ENERGY) if name else hs.DeltaBeta(0.0, 0.0)


def run(name: str, size: str, how: str, seed: int, made: Scene) -> Row:
    """One run of a scene, judged."""
    scan, began, found, verdict = made.scan, time.process_time(), None, ""
    grid, drawn = Grid.of_views(scan.views), made.drawn
    if how == "wall told":
        assert isinstance(made.kind, Cuvette | Channel)
        scan = scan.taken(replace(scan.exposures, wall=wall_of(made.kind, made.substances)))
        region, matter = made.within
        bodies = drawn.regions[region]
        assert isinstance(bodies, MeshScene)
        drawn = Drawn(MeshScene.of_one_material(bodies.meshes, matter), drawn.text)
    try:
        done = hs.reconstruct(scan, made.told(how), TEXTBOOK if how == "Paganin, TV" else Auto())
        found, result = done.object.voxelise(grid), done.object.kind
        verdict = "" if done.verdict is None else "good" if done.verdict.good else "not good"
    except hs.InputError as refusal:
        result = str(refusal)
    seconds = time.process_time() - began
    error, overlap, total, holes = judged(found, drawn, grid)
    pixels, count, photons = SIZES[size]
    return Row(
        *(name, size, how, seed, "reporting" if seed > 100 else "development"),
        *(error, overlap, total, holes, result, verdict),
        f"{count} × {pixels} × {pixels}, {'no noise' if photons is None else f'{photons:.0f} photons'}",
        *(made.drawn.text, round(seconds, 1), machine(), commit()),
    )


def judged(found: Volume | None, drawn: Drawn, grid: Grid) -> tuple[float, float, float, float | str]:
    """Error of δ, Dice, total over the true one, and Dice of holes that are filled with the medium (empty: none)."""
    if found is None:
        return math.inf, 0.0, math.nan, ""
    true = drawn.scene.voxelise(grid)
    scores = volume_scores(found, true)
    total = float(found.delta.sum(dtype=np.float64) / true.delta.sum(dtype=np.float64))
    named = [drawn.regions[name] for name in ("bubbles", "keyhole", "pores") if name in drawn.regions]
    hole = sum((one.voxelise(grid).delta for one in named), np.zeros(grid.shape)) > 0.5
    if not hole.any() or np.abs(true.delta[hole]).mean() > 0.5 * abs(scores.material_delta):
        return scores.relative_error_delta, scores.dice, total, ""
    near = binary_dilation(hole, iterations=AROUND)
    level = found.delta / scores.material_delta < 0.5
    return scores.relative_error_delta, scores.dice, total, dice(level & near, hole & near)


def rows_of(path: Path) -> list[Row]:
    """The rows that are there."""
    kinds = {field.name: {"int": int, "float": float}.get(str(field.type), str) for field in fields(Row)}
    return [Row(**{name: kinds[name](value) for name, value in each.items()}) for each in read(path)]


def main() -> None:
    """Make the rows that are not there yet, each written as soon as it is made, or print what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=(*MATTER, BARE), default=[*MATTER, BARE])
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--summary", action="store_true", help="print the rows, and make none")
    options = parser.parse_args()
    torch.set_num_threads(1)
    wanted = [
        (kind, size, how, seed)
        for seed in options.seeds
        for size in options.sizes
        for how in options.runs
        for kind in options.kinds
        if how != "wall told" or issubclass(MATTER[kind], Cuvette | Channel)
    ]
    for kind, size, how, seed in wanted if not options.summary else ():
        there = {(row.kind, row.size, row.run, row.seed) for row in rows_of(options.out)}
        if (kind, size, how, seed) not in there:
            row = run(kind, size, how, seed, scene(kind, size, seed))
            replaced(options.out, row, key=4)
            shown(row)
    if options.summary:
        for row in rows_of(options.out):
            print(f"{row.kind:9} {row.size:5} {row.run:13} {row.seed:3} {row.error:.3f} {row.dice:.3f} {row.total:.3f}")


if __name__ == "__main__":
    main()
