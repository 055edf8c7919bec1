"""What stands in for a reader's files, and for hours, where blocks of the documentation are run at a small size."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from helpers.doc_blocks import FAR, Block
from holosplat.methods import Auto
from holosplat.tables import to_table

SCENE = "--detector 16 16 --views 4 --test-every 4"
SCAN = f"holosplat simulate --specimen bubbles --material haemoglobin --pixel-size 2e-6 {SCENE} --out"
"""Words that make a scan of a few frames."""
WATER = f"holosplat simulate --specimen bubbles --specimen-count 2 --medium water --pixel-size 1e-6 {SCENE}"
RUN = f"{SCAN} seen.nxs && holosplat reconstruct seen.nxs --material haemoglobin --preset fast --out"
FLOW = """
holosplat grow --cells 1 --box 16e-6 12e-6 12e-6 --flow 0.05 --snapshots 4 --frequency 3 --out grown
holosplat simulate grown/cells.pvd --period 16 0 0 --frame-rate 56400 --material haemoglobin --detector 24 24 \\
    --pixel-size 0.6e-6 --views 3 --test-every 0 --out scan.nxs
"""
TRACK = "--effort 0.05 --pieces 1 --rounds 0 --no-intervals"
SPHERES = """
python - <<'PYTHON'
from pathlib import Path
import numpy as np
import holosplat as hs
from holosplat.io import write_mesh
from holosplat.specimens.red_cells import icosphere

vertices, faces = icosphere(3)
beads = [(9, -8, 3), (-10, 5, 7), (2, 12, -11)]
for name, radius, places in (("cells", 8, [(0, 0, 0), (18, 4, 9)]), ("beads", 3.5, beads)):
    Path(name).mkdir()
    for n, place in enumerate(places):
        mesh = hs.mesh.TriangleMesh(1e-6 * (radius * vertices + np.array(place)), faces)
        write_mesh(Path(name) / f"body{n}.vtk", mesh, "um")
PYTHON
"""
BEAMS = f"""{SPHERES}
for n in 1 2 3 4; do
    beam="--angles-deg $((40 * n)) --tilts-deg 0 --detector 48 48 --pixel-size 1e-6 --distance 0.05 --test-every 0"
    holosplat simulate cells/*.vtk --material haemoglobin $beam --out seen$n.nxs
    holosplat record seen$n.nxs --photons-per-pixel 20000 --flats 8 --darks 4 --seed $n --out raw$n.nxs
    holosplat simulate beads/*.vtk --material polystyrene $beam --origin 0 0 0 --out beads$n.nxs
done
rm seen2.nxs raw2.nxs
"""
TURNS = "--views 16 --test-every 0 --distance 0 --pixel-size 42.92e-6"
TOOTH = """
python - <<'PYTHON'
import h5py
import numpy as np

angles, columns = np.linspace(0, 180, 181), np.arange(295)
centre = 147.25 + 60 * np.cos(np.deg2rad(angles))
light = np.exp(-np.maximum(0, 1 - ((columns - centre[:, None]) / 40) ** 2))
with h5py.File("tooth.h5", "w") as file:
    file["exchange/data"] = np.repeat(1000 + 9000 * light[:, None], 2, axis=1).astype("u2")
    file["exchange/data_white"] = np.full((4, 2, 295), 10000, "u2")
    file["exchange/data_dark"] = np.full((4, 2, 295), 1000, "u2")
    file["exchange/theta"] = angles
PYTHON
"""
SLICES = """
python - <<'PYTHON'
from pathlib import Path
import numpy as np
import tifffile

Path("slices").mkdir()
z, y, x = np.indices((12, 12, 12)) - 5.5
for n, inside in enumerate(np.sqrt(x**2 + y**2 + z**2) < 4):
    tifffile.imwrite(f"slices/{n:03d}.tif", inside.astype("f4"))
PYTHON
"""
BODIES = r"""
python - <<'PYTHON'
from pathlib import Path
import numpy as np
import holosplat as hs
from holosplat.io import write_mesh
from holosplat.specimens.red_cells import icosphere

vertices, faces = icosphere(2)

def mesh(radii, place, bend=0.0):
    x, y, z = (vertices * np.array(radii)).T
    return hs.mesh.TriangleMesh(1e-6 * (np.stack([x + bend * y**2, y, z], 1) + np.array(place)), faces)

Path("beads").mkdir()
Path("espresso/vtk").mkdir(parents=True)
for n, place in enumerate([(0, -4, 1), (-3, 3, 2), (3, 4, -3)]):
    write_mesh(f"beads/bead{n}.vtk", mesh((2.5, 2.5, 2.5), place), "um")
bracket = mesh((5, 3, 2), (0, 0, 0), 0.2)
write_mesh("bracket.vtk", bracket, "um")
corners = "".join("outer loop\n" + "".join("vertex %f %f %f\n" % tuple(c) for c in t) + "endloop\n"
                  for t in 1e6 * bracket.vertices[bracket.faces])
facets = corners.replace("outer", "facet normal 0 0 0\nouter").replace("endloop", "endloop\nendfacet")
Path("bracket.stl").write_text(f"solid bracket\n{facets}endsolid bracket\n")
for n in range(4):
    file = Path(f"espresso/vtk/cell0_{n:03d}.vtk")
    write_mesh(file, mesh((3, 3, 3), (n, 6, 6)), "um")
    first, _, rest = file.read_bytes().split(b"\n", 2)
    file.write_bytes(b"\n".join([first, b"t=%dus" % (10 * n), rest]))
PYTHON
"""
SEEN = "--pixel-size 0.6e-6 --detector 32 32 --views 3 --test-every 0 --distance 0.02 --origin 0 0 0"
KINDS = "bubbles flotation cuvette crack keyhole jet break-up shock lattice fibres star channel"


@dataclass(frozen=True)
class Small:
    """before: commands that make files which stand in for the reader's; more: words that each command of holosplat gets
    beside those of the page, of which the last ones count; without: a word of a block that is left out, or nothing."""

    before: str = ""
    more: Mapping[str, str] = field(default_factory=dict)
    without: str = ""

    def takes(self, block: Block) -> bool:
        """Whether it runs a block, which does not run as it stands."""
        own = block.language == "sh" and not block.runs and not FAR.match(block.text)
        return own and not (self.without and self.without in block.text)

    def shell(self) -> str:
        """What a shell reads before a block: `holosplat` with these words."""
        cases = "\n".join(f'        {name}) set -- "$@" {words} ;;' for name, words in self.more.items())
        return f'holosplat() {{\n    case "$1" in\n{cases}\n        *) ;;\n    esac\n    command holosplat "$@"\n}}\n'


FAST = {"reconstruct": "--preset fast"}
BOTH_SIDES = """$(case "$*" in *both*|*nylon*) echo --method volume ;; *) echo --preset fast ;; esac)"""
"""Gaussians lie on one side of their medium, and so few pixels of fibres show none."""
LAST = "--truth truth_t0002.h5"
OF_CELLS = "--frames 3 --frame-rate 1e5 --pulses 2 --truth-frames 0 2"
SNAPSHOTS = f"""$(case "$*" in *espresso*) echo {OF_CELLS} ;; *) echo --views 4 ;; esac)"""
PAGES: dict[str, Small] = {
    "README.md": Small(f"{SCAN} my_scan.h5", FAST),
    "alignment.md": Small(
        f"""{BODIES}
        holosplat simulate --specimen tissue --material bone --detector 8 32 {TURNS} --out turned.nxs
        holosplat record turned.nxs --flats 4 --darks 2 --out capsule.h5
        holosplat simulate bracket.vtk --material PMMA {SEEN} --out phantom.nxs
        holosplat simulate beads/*.vtk --material polystyrene {SEEN} --out beads.nxs
        holosplat simulate bracket.vtk --material haemoglobin {SEEN} --out other.nxs""",
        {"reconstruct": "--preset fast"},
    ),
    "cells.md": Small("", {"grow": "--cells 1 --box 16e-6 12e-6 12e-6 --snapshots 2 --frequency 3"}),
    "forecast.md": Small(
        f"""{FLOW.replace("--snapshots 4", "--snapshots 8")}
        holosplat track scan.nxs --material haemoglobin {TRACK} --out run""",
        {
            "grow": "--cells 3 --box 30e-6 16e-6 16e-6 --snapshots 50 --frequency 3 --device cpu",
            "train": "--steps 2 --device cpu",
            "simulate": "--detector 12 15",
            "forecast": "--times 5",
        },
        "32e-6",
    ),
    "four_beams.md": Small(BEAMS, FAST),
    "howto/bubbles.md": Small(
        f"{WATER} --detector 32 32 --out bubbles.nxs --truth truth.h5",
        {"simulate": SCENE},
    ),
    "howto/tooth.md": Small(TOOTH),
    "howto/unknown_material.md": Small(f"{SCAN} scan.nxs"),
    "howto/which_matter.md": Small(
        f"""for kind in {KINDS}; do
            holosplat simulate --specimen $kind --pixel-size 2e-6 {SCENE} --detector 24 24 --out $kind.nxs \\
                --truth $kind.h5
        done""",
        {"reconstruct": BOTH_SIDES},
    ),
    "imaging_chain.md": Small(f"for n in 0 1 2; do {SCAN} beam$n.nxs; done"),
    "motion.md": Small(FLOW, {"track": TRACK}),
    "series.md": Small(f"mkdir incoming && {SCAN} incoming/a.nxs", {"watch": "--idle 1 --settle 0.1 --poll 0.1"}),
    "simulation.md": Small(
        SLICES + BODIES,
        {"simulate": f"--detector 16 16 {SNAPSHOTS}", "reconstruct": "--time-frame 2 --preset fast", "evaluate": LAST},
    ),
    "verdict.md": Small(f"{RUN} run && cp -r run another_run"),
}
"""Pages whose blocks that do not run as they stand are run so. What is missing was not seen to work at a small size."""


def of_few_steps(folder: Path) -> Path:
    """A file in a folder that shells read before blocks of any page: their commands take few steps of fits, and try few
    instruments."""
    method, shell = folder / "method.json", folder / "shell.sh"
    auto = Auto().with_effort(0.02)
    coarse = replace(auto.gaussians.coarse, turns=0, join_missing=False)  # none is missing that so few steps would find
    method.write_text(json.dumps(to_table(replace(auto, gaussians=replace(auto.gaussians, coarse=coarse)))))
    fits = f"""$(case "$*" in *--method*|*--preset*) ;; *) echo --config {method} ;; esac)"""
    series = """$(case "$2" in plan) echo --preset fast ;; esac)"""
    more = {"plan": "--points 5 3", "reconstruct": fits, "series": series, "track": TRACK}
    shell.write_text(Small(more=more).shell(), encoding="utf-8")
    return shell
