"""From red cells to holograms and back, in a few lines: `python 01_simulate_and_reconstruct.py [folder]`.

Takes about ten seconds. The folder (default: example_01) gets the scan, the run and the volume; a run that is there
already is not overwritten.
"""

import sys
from pathlib import Path

import holosplat as hs


def main(out: Path) -> None:
    """Simulate, reconstruct, evaluate, export."""
    out.mkdir(parents=True, exist_ok=True)

    # Detector and beam, in SI units: 48 × 60 pixels of 0.65 µm, twelve views over 180°, 20 keV, 10 cm behind the cells.
    # These are effective values in the sample plane: of a cone beam, those of the equivalent parallel one.
    views = hs.Views.evenly_spaced(12, shape=(48, 60), pixel_size=0.65e-6)
    exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.1, psf_sigma_px=0.5)

    # The specimen: eight red cells, turned and placed at random about the origin, which lies on the rotation axis (y).
    # Your own cells: hs.beamline.read_scene(["cell1.vtk", …], hs.beamline.Filling(…), 20.0, length_unit="um").
    haemoglobin = hs.materials.HAEMOGLOBIN.delta_beta(20.0)  # δ and β; in plasma: RED_CELL… .against(PLASMA…)
    cells = hs.specimens.random_cells(8, box=(views.width, views.height, views.width), seed=1)
    scene = hs.MeshScene.of_one_material(cells, haemoglobin)

    # The measurement, with photon noise. Every fourth view is held out: the fit never sees it, the scores are on it.
    # A scan of your own is read by hs.io.read_scan("scan.nxs"); docs/conventions.md lists the fields.
    scan = hs.simulate(scene, exposures, photons_per_pixel=10_000, seed=1)
    hs.io.write_scan(out / "scan.nxs", scan)

    # The reconstruction. What you know of the matter goes in as the prior: its δ and β here; else only their ratio,
    # hs.MaterialPrior.of_ratio(2800), or nothing, hs.MaterialPrior.unknown(). Without a method it is hs.Gaussians(),
    # which is better and slower than the preset "fast".
    prior = hs.MaterialPrior.known(haemoglobin)
    run = hs.RunFolder(out / "run")
    result = hs.reconstruct(scan, prior, hs.preset("fast"), seed=0, folder=run)

    # How good is it? On the held-out views, and against the true volume, which only a simulation has.
    grid = hs.Grid.of_views(views)
    scores = hs.evaluate(result, scan, truth=scene.voxelise(grid))
    print(f"{len(result.object)} Gaussians in {sum(result.timing.values()):.1f} s")
    print(*scores.lines(), sep="\n")

    # δ and β on voxels, for any other program (HDF5: /delta and /beta, [z, y, x]).
    hs.io.write_volume(out / "volume.h5", result.object.voxelise(grid))
    print(f"wrote {out / 'scan.nxs'}, {out / 'run'} and {out / 'volume.h5'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_01"))
