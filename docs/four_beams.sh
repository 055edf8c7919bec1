#!/bin/sh
# From raw frames of four beams that are not where they say to a volume: the commands of docs/four_beams.md.
# Writes into the new folder FOLDER (default: four_beams): sh docs/four_beams.sh FOLDER
set -e
mkdir "${1:-four_beams}" && cd "${1:-four_beams}" && mkdir cells beads

# Five red cells, which the beamline does not know, and a phantom of six beads.
python - <<'PYTHON'
from pathlib import Path

import numpy as np

import holosplat as hs
from holosplat.io import write_mesh
from holosplat.specimens.red_cells import icosphere

for cell in hs.specimens.random_cells(5, (60e-6, 56e-6, 60e-6), 5, 26e-6):
    write_mesh(Path("cells") / f"{cell.name}.vtk", cell, "um")
vertices, faces = icosphere(4)
for n, place in enumerate([(9, -8, 3), (-10, 5, 7), (2, 12, -11), (-5, -13, -8), (14, 4, -3), (-3, 1, 13)]):
    bead = hs.mesh.TriangleMesh(1e-6 * (3.5 * vertices + np.array(place)), faces)
    write_mesh(Path("beads") / f"bead{n}.vtk", bead, "um")
PYTHON

# Each beam has a camera of its own; its file says an angle, and is off by about 1 px, 0.6° and 2 %.
beam() {
    geometry="--angles-deg $2 --tilts-deg $3 --detector 64 64 --pixel-size 1e-6 --distance 0.05 --test-every 0
        --misalign-shift 1 --misalign-rotation 0.6 --misalign-distance 0.02 --misalign-seed $1"
    holosplat simulate cells/*.vtk $geometry --out "seen$1.nxs" --true-exposures "true$1.nxs"
    holosplat record "seen$1.nxs" --photons-per-pixel 20000 --flats 200 --darks 20 --seed "$1" --out "raw$1.nxs"
    holosplat simulate beads/*.vtk --material polystyrene $geometry --origin 0 0 0 --out "beads$1.nxs"
}
beam 1 0 0
beam 2 40 8
beam 3 85 -6
beam 4 130 4

# From here on, only what a beamline has: raw1.nxs … raw4.nxs, and frames of the beads.
for n in 1 2 3 4; do holosplat correct "raw$n.nxs" --out "corrected$n.nxs"; done
holosplat join corrected1.nxs corrected2.nxs corrected3.nxs corrected4.nxs --out scan.nxs
holosplat join beads1.nxs beads2.nxs beads3.nxs beads4.nxs --out beads.nxs
holosplat calibrate beads.nxs --beads 3.5e-6 --material polystyrene --out geometry.toml
holosplat reconstruct scan.nxs --exposures geometry.toml --material haemoglobin --out run

# How near it came to the truth, which a beamline does not have.
python - <<'PYTHON'
from dataclasses import replace

import numpy as np

from holosplat.align.derivatives import changes, moved_onto
from holosplat.io import read_beams, read_scan

files = [read_scan(f"true{n}.nxs").exposures for n in (1, 2, 3, 4)]
scan = read_scan("scan.nxs")
rotations, shifts = (np.concatenate([getattr(each.views, name) for each in files]) for name in ("rotations", "shifts"))
views = replace(scan.views, rotations=rotations, shifts=shifts)
true = replace(scan.exposures, views=views, distance=np.concatenate([each.distance for each in files]))
for name, exposures in (("planned", scan.exposures), ("found", read_beams("geometry.toml").applied(scan).exposures)):
    away = changes(replace(exposures, views=moved_onto(exposures.views, views)), true)
    shift, across, roll, distance = (np.sqrt(np.square(away[:, at]).mean()) for at in ([0, 1], [2, 3], [4], [5]))
    print(f"{name}: shifts {shift:.4f} px, turns {across:.4f}°, roll {roll:.4f}°, distance {distance:.2%} (rms errors)")
PYTHON
