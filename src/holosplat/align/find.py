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
    """Find the true poses of the views of `scan` from its frames.

    prior: of the material
    options: the uncertainty of the planned poses, and the search

    The result has the corrected `exposures`, and for each view `changes` and standard `errors` [V, 7]: shifts x, y
    [pixels], rotations about x, y, z [degrees], shares of distance and magnification. Poses that explain the frames no
    better than the planned ones are not taken. Series have one geometry for all times, and two or three beams in one
    plane are aligned by their rows (`align_beams`); all other scans, and distances, by a volume (`align_still`).
    Errors: `InputError` for fewer than two training frames of a time, and for series in which no beam has two times.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> found = hs.align_views(scan, hs.MaterialPrior.known(water))
        >>> found.changes.shape
        (8, 7)
        >>> moved = scan.with_views(found.exposures.views)
    """
    train = ~scan.is_test
    posed = options.uncertain.distance == 0 and options.uncertain.magnification == 0
    few = posed and bool(train.any()) and int(train.sum()) < FEW and plane_angles(scan.views) is not None
    how = align_beams if scan.is_series or few else align_still
    return how(scan, prior, options, light=light, on_progress=on_progress)
