"""Surfaces: `python 05_surfaces.py [folder]`.

If the matter consists of closed bodies, their surfaces are extracted from the Gaussians and fitted to the same frames.
Surfaces have sharp edges, so the volume becomes sharper; and the bodies are triangle meshes for other programs.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import holosplat as hs


def main(out: Path) -> None:
    """Gaussians and surfaces of the same scan, both against the truth; the bodies as a VTK file."""
    out.mkdir(parents=True, exist_ok=True)
    views = hs.Views.evenly_spaced(12, shape=(40, 40), pixel_size=0.78e-6)
    material = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(4, box=(views.width,) * 3, seed=4), material)
    scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.1), photons_per_pixel=10_000, seed=4)

    # A method is an object that holds its options. Surfaces start from the Gaussians of their own options.
    fast = hs.preset("fast")
    grid = hs.Grid.of_views(views)
    truth = scene.voxelise(grid)
    _, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
    volumes = {"truth": truth}
    for method in (fast, hs.Surfaces(gaussians=fast)):
        result = hs.reconstruct(scan, hs.MaterialPrior.known(material), method)
        scores = hs.evaluate(result, scan, truth=truth).headline()
        print(f"{method.kind}: Dice {scores['dice']:.3f}, error of δ {scores['relative_error_delta']:.3f}")
        volumes[method.kind] = result.object.voxelise(grid)
    for axis, (name, volume) in zip(axes, volumes.items()):
        axis.imshow(volume.delta.max(axis=0), cmap="magma", vmin=0, vmax=1.2 * material.delta)
        axis.set_title(name)
    plt.savefig(out / "largest_delta_along_z.png", dpi=100)

    bodies = result.object.mesh()
    hs.io.write_mesh(out / "bodies.vtk", bodies, length_unit="um")
    print(f"{len(bodies.vertices)} vertices, {len(bodies.faces)} triangles")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_05"))
