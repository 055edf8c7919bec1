"""Your own meshes: `python 02_own_meshes.py [folder]`.

Any closed triangle meshes in VTK files will do, one file for each body. This example writes three cells as another
program would, in micrometres, and then treats them as files that somebody else made.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import holosplat as hs

ENERGY_KEV = 20.0


def main(out: Path) -> None:
    """Write meshes, read them as a scene, simulate a scan file, reconstruct it, compare."""
    out.mkdir(parents=True, exist_ok=True)
    for number, mesh in enumerate(hs.specimens.random_cells(3, box=(24e-6, 16e-6, 24e-6), seed=5)):
        hs.io.write_mesh(out / f"cell{number}.vtk", mesh, length_unit="um")

    # The files have no unit and no material: both are said here. Several materials: Filling(table={"cell1*": …}).
    # The middle of all meshes comes to the origin, on the rotation axis y; origin=(x, y, z) chooses another point.
    filling = hs.beamline.Filling(hs.materials.HAEMOGLOBIN, medium=None)
    scene = hs.beamline.read_scene(sorted(out.glob("cell*.vtk")), filling, ENERGY_KEV, length_unit="um")

    # 40 × 40 pixels of 0.78 µm show a field of 31 µm; a mesh that leaves it would be cut off in some views.
    views = hs.Views.evenly_spaced(12, shape=(40, 40), pixel_size=0.78e-6)
    print(f"{len(scene.meshes)} meshes, with {-1e6 * scene.missing_field(views):.1f} µm of free field around them")
    hs.io.write_scan(out / "scan.nxs", hs.simulate(scene, hs.Exposures.of(views, ENERGY_KEV, distance=0.1)))

    # From here on as with a measured scan: the file (NXtomo) and the material are all that the reconstruction gets.
    scan = hs.io.read_scan(out / "scan.nxs")
    prior = hs.MaterialPrior.known(hs.materials.HAEMOGLOBIN.delta_beta(ENERGY_KEV))
    result = hs.reconstruct(scan, prior, hs.preset("fast"))
    grid = hs.Grid.of_views(views)
    truth, found = scene.voxelise(grid), result.object.voxelise(grid)
    print(*hs.evaluate(result, scan, truth=truth).lines(), sep="\n")

    _, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
    axes[0].imshow(scan.frames[0], cmap="gray")
    for axis, volume, title in ((axes[1], truth, "true δ, largest along z"), (axes[2], found, "reconstructed δ")):
        axis.imshow(volume.delta.max(axis=0), cmap="magma", vmin=0, vmax=float(truth.delta.max()))
        axis.set_title(title)
    axes[0].set_title("hologram of the first view")
    plt.savefig(out / "hologram_and_volumes.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_02"))
