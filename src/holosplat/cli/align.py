"""`holosplat align`: where the beams of a scan really are."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from ..checks import require
from ..io.reading import Reading
from ..matter import Known, KnownRatio, MaterialPrior
from .options import LightFlags, PriorOptions
from .progress import ProgressBar

LIGHT = LightFlags()
"""Even, unless the air of frames says otherwise."""


def align(
    scan: Positional[Path],
    out: Path,
    matter: PriorOptions = PriorOptions(),
    axis_only: bool = False,
    reading: Reading = Reading(),
    *,
    illumination: LightFlags = LIGHT,
) -> None:
    """Find where the beams of a scan really are, and write the same frames with other exposures.

    Args:
        scan: Scan: a file (NXtomo), or a folder (tiff, nerf-synthetic, r2-gaussian, or a run's).
        out: Scan file to write (NXtomo).
        axis_only: The object turns about one axis; find its column, and how it leans in the image.
    """
    from ..align import find_axis
    from ..io.atomic import require_apart, require_writable
    from ..io.formats import read_as
    from ..io.nxtomo import write_scan
    from ..scan import Scan

    require(axis_only, "align finds the axis of turning objects so far; add --axis-only.")
    require_writable(out)
    require_apart(out, scan)
    measured = read_as(scan, reading).in_memory()
    prior = matter.prior(measured.exposures.reference_energy)
    with ProgressBar() as bar:
        axis = find_axis(
            measured,
            ratio=_ratio(prior),
            light=illumination.options(),
            on_progress=lambda fraction: bar.show("axis", fraction, {}),
        )
    lines = axis.lines()
    for line in lines:
        print(line)
    facts = measured.provenance | {"aligned": "; ".join(lines)}
    write_scan(out, Scan.of(measured.source, axis.applied(measured.exposures), measured.is_test, facts))
    print(f"wrote {out}: the same {len(measured)} frames, with the axis where it is", file=sys.stderr)


def _ratio(prior: MaterialPrior) -> float | None:
    """δ/β, where it is known and positive."""
    if isinstance(prior, KnownRatio):
        return prior.ratio
    if isinstance(prior, Known) and prior.materials[0].beta > 0:
        return prior.materials[0].ratio
    return None
