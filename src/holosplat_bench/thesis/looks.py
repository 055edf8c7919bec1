"""What is seen of a fit on its way: all scores, and pictures of what the Gaussians add up to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from holosplat.fit.loop import Fit
from holosplat.methods import finished
from holosplat.units import wavenumber
from holosplat.volume import Object
from holosplat.workflows.evaluate import score_object

from .cloud import DenseCloud
from .measured import Measured, mean_inside

SHOWN = (0.0, 0.04, 0.1, 0.25, 0.5, 1.0)
"""Shares of the steps after which the line integrals are kept: the start, the warm-up behind it, the first
densification, two on the way, and the end."""


def scores(fit: Fit, measured: Measured, loss: float) -> dict[str, float]:
    """All scores of the cloud as it is now; loss: that of the last step."""
    cloud = cloud_of(fit)
    found = score_object(cloud, measured.scan, measured.truth, fit.oversample)
    assert found.test is not None
    assert found.train is not None
    assert found.volume is not None
    delta, beta = mean_inside(cloud.voxelise(measured.truth.grid), measured.truth)
    ratios = cloud.ratios()
    return {
        "step": fit.step,
        "seconds": fit.seconds,
        "count": len(cloud),
        **{f"test_{score}": value for score, value in found.test.mean.items()},
        **{f"train_{score}": value for score, value in found.train.mean.items()},
        "loss": loss,
        "dice": found.volume.dice,
        "relative_error_delta": found.volume.relative_error_delta,
        "mean_delta": delta,
        "mean_beta": beta,
        "ratio": delta / beta if beta > 0 else float("inf"),
        "own_ratio": float(ratios.mean()) if len(cloud) else float("nan"),
        "median_own_ratio": float(ratios.median()) if len(cloud) else float("nan"),
    }


def line_integrals(obj: Object, measured: Measured) -> torch.Tensor:
    """k ∫δ and k ∫β [2, H, W] of `obj` in the first held-out view, float32: phase shift, and half the absorbance."""
    exposures = measured.scan.test().exposures[np.array([0])]
    with torch.no_grad():
        beta, delta = obj.project(exposures.views)
    return (float(wavenumber(exposures.energy_kev)[0]) * torch.cat((delta, beta))).float()


def geometry(fit: Fit, measured: Measured) -> dict[str, np.ndarray]:
    """A slice of δ through the middle of the field, and that of the truth [Y, X]."""
    cloud, grid = cloud_of(fit), measured.truth.grid
    middle = grid.shape[0] // 2
    return {
        "slice": cloud.voxelise(grid).delta[middle].astype(np.float32),
        "true_slice": measured.truth.delta[middle].astype(np.float32),
    }


def maps(
    taken: Sequence[tuple[int, torch.Tensor]], shapes: dict[str, np.ndarray], measured: Measured
) -> dict[str, np.ndarray]:
    """What NAME.maps.npz holds: `steps` [K] and `lines` [K, 2, H, W] of `taken`, `true_lines`, and the geometry."""
    return {
        "steps": np.array([step for step, _ in taken]),
        "lines": torch.stack([lines for _, lines in taken]).numpy(),
        "true_lines": line_integrals(measured.scene, measured).numpy(),
        **shapes,
    }


def due(step: int, before: int, steps: int) -> bool:
    """Whether one of the `SHOWN` shares of `steps` lies behind `before` and not behind `step`."""
    return any(before < share * steps <= step for share in SHOWN)


def cloud_of(fit: Fit) -> DenseCloud:
    """The cloud as it is now, in main memory."""
    cloud = finished(fit)
    assert isinstance(cloud, DenseCloud)
    return cloud
