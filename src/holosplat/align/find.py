"""`align_views`: where the views of any scan really are."""

from __future__ import annotations

from ..matter import MaterialPrior
from ..optics.background import LightOptions
from ..progress import Progress
from ..scan import Scan
from .beams import align_beams
from .poses import PoseOptions
from .row_sums import plane_angles
from .shadows import EVEN_OR_NOT
from .views import DEFAULT, FEW, AlignedViews, align_still


def align_views(
    scan: Scan,
    prior: MaterialPrior,
    options: PoseOptions = DEFAULT,
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Progress = lambda stage, fraction: None,
) -> AlignedViews:
    """Where the views of `scan` really are, from the frames alone.

    Series have one geometry for all times, and two or three beams in one plane what their rows tell (`align_beams`);
    all other scans, and distances, what a volume tells (`align_still`). Errors: `InputError` for fewer than two
    training frames of a time, and for series whose beams are never seen twice.
    """
    train = ~scan.is_test
    posed = options.uncertain.distance == 0 and options.uncertain.magnification == 0
    few = posed and bool(train.any()) and int(train.sum()) < FEW and plane_angles(scan.views) is not None
    how = align_beams if scan.is_series or few else align_still
    return how(scan, prior, options, light=light, on_progress=on_progress)
