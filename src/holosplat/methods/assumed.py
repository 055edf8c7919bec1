"""The one material that stands for all matter in a first volume."""

from __future__ import annotations

from ..backends import Backend
from ..baselines.material import DEFAULT, MaterialEstimate, estimate_delta, estimate_ratio
from ..matter import DeltaBeta, KnownRatio, MaterialPrior
from ..progress import Progress
from ..scan import Scan


def assumed_material(
    scan: Scan,
    prior: MaterialPrior,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
) -> DeltaBeta:
    """δ and β of one material for all matter: as known, or as the training frames `scan` suggest.

    Where several are known, it has the δ of the first, and the ratio of an equal mixture. What is estimated has the
    sign of δ that the prior says, or is above the medium where it says none.
    """
    if prior.materials:
        deltas, betas = zip(*prior.materials)
        return DeltaBeta(deltas[0], deltas[0] * sum(betas) / sum(deltas)) if betas[1:] else prior.materials[0]
    how = (on_progress, backend, options, prior.delta_sign)
    ratio = prior.ratio if isinstance(prior, KnownRatio) else estimate_ratio(scan, *how)
    delta = estimate_delta(scan, ratio, *how, prior.two_sided)
    return DeltaBeta(delta, delta / ratio)
