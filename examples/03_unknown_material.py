"""Unknown material: `python 03_unknown_material.py [folder]`.

The prior says what is known of the matter: δ and β, only their ratio, or nothing. The same scan is reconstructed with
each of the three. With the ratio alone, all matter has one δ, that of the likeliest volume. With nothing known, δ is
free in every place, and finds its level in the fit.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import holosplat as hs


def main(out: Path) -> None:
    """Simulate one scan and reconstruct it with three priors."""
    out.mkdir(parents=True, exist_ok=True)
    views = hs.Views.evenly_spaced(12, shape=(48, 48), pixel_size=0.65e-6)
    material = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
    cells = hs.specimens.random_cells(4, box=(views.width,) * 3, seed=2)
    scene = hs.MeshScene.of_one_material(cells, material)
    scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.1), photons_per_pixel=20_000, seed=2)

    # Without a material, the ratio δ/β is one that predicts unseen views well, and δ varies freely.
    # Where the start shows two levels, two materials are told apart. See docs/method.md.
    ratio = material.delta / material.beta
    priors = {
        "δ and β known": hs.MaterialPrior.known(material),
        "δ/β known": hs.MaterialPrior.of_ratio(ratio),
        "nothing known": hs.MaterialPrior.unknown(),
    }
    grid = hs.Grid.of_views(views)
    truth = scene.voxelise(grid)
    print(f"the truth: δ = {material.delta:.3e}, δ/β = {ratio:.0f}")
    _, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
    for axis, (name, prior) in zip(axes, priors.items()):
        result = hs.reconstruct(scan, prior, hs.preset("fast"))
        scores = hs.evaluate(result, scan, truth=truth)
        numbers, found = scores.headline(), scores.material
        print(
            f"{name}: found δ = {found.delta:.3e}, δ/β = {found.ratio:.0f}; Dice {numbers['dice']:.3f}, "
            f"error of δ {numbers['relative_error_delta']:.3f}, SSIM of held-out frames {numbers['ssim']:.3f}"
        )
        axis.imshow(result.object.voxelise(grid).delta.max(axis=0), cmap="magma", vmin=0, vmax=1.2 * material.delta)
        axis.set_title(name)
    plt.savefig(out / "largest_delta_along_z.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_03"))
