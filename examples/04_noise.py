"""Noise: `python 04_noise.py [folder]`.

Fewer photons make noisier frames. The reconstruction measures the noise in the frames and adapts to it; nothing has to
be set. The scores are on noise-free held-out frames, so that they measure the object and not the noise.
"""

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

import holosplat as hs


def main(out: Path) -> None:
    """Reconstruct the same cells from frames of fewer and fewer photons."""
    out.mkdir(parents=True, exist_ok=True)
    views = hs.Views.evenly_spaced(12, shape=(40, 40), pixel_size=0.78e-6)
    material = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(4, box=(views.width,) * 3, seed=3), material)
    clean = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.1))
    grid = hs.Grid.of_views(views)
    truth = scene.voxelise(grid)

    _, axes = plt.subplots(2, 3, figsize=(8, 5.6), layout="constrained")
    for column, photons in zip(axes.T, (None, 2_000, 200)):
        scan = hs.simulate(scene, clean.exposures, photons_per_pixel=photons, seed=3)
        result = hs.reconstruct(scan, hs.MaterialPrior.known(material), hs.preset("fast"))
        held_out = clean.is_test[:, None, None]
        judged = replace(scan, frames=(~held_out * scan.frames + held_out * clean.frames))
        numbers = hs.evaluate(result, judged, truth=truth).headline()
        light = f"{photons} photons a pixel" if photons else "no noise"
        print(
            f"{light}: {len(result.object)} Gaussians, SSIM {numbers['ssim']:.3f}, FRCM {numbers['frcm']:.3f}, "
            f"Dice {numbers['dice']:.3f}, error of δ {numbers['relative_error_delta']:.3f}"
        )
        column[0].imshow(scan.frames[1], cmap="gray", vmin=clean.frames.min(), vmax=clean.frames.max())
        column[1].imshow(
            result.object.voxelise(grid).delta.max(axis=0), cmap="magma", vmin=0, vmax=1.2 * material.delta
        )
        column[0].set_title(light)
    axes[0, 0].set_ylabel("a training frame")
    axes[1, 0].set_ylabel("largest δ along z")
    plt.savefig(out / "frames_and_volumes.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_04"))
