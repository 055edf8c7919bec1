"""`holosplat grow`: cells carried and deformed by the flow through a channel, as a time series of meshes."""

from __future__ import annotations

import sys
from pathlib import Path

from ..beamline.grow import Growth, SeriesFolder
from ..beamline.grow import grow as run
from ..io.lock import sole_writer
from .progress import INTERRUPTED, ProgressBar


def grow(out: Path, what: Growth, resume: bool = False) -> None:
    """Let red cells flow through a channel, and write their meshes (VTK, µm) at every snapshot.

    Args:
        out: Folder to make: rbcCC_TTT.vtp for cell CC at snapshot TTT, and cells.pvd, which ParaView opens.
        resume: Go on with an interrupted run, or to more snapshots.
    """
    try:
        with sole_writer(out), ProgressBar() as bar:
            grown = run(what, out, resume, lambda fraction: bar.show("cells in flow", fraction, {}))
    except KeyboardInterrupt:
        begun = SeriesFolder(out).state.is_file()
        _say(f"interrupted; {'snapshots so far stay in' if begun else 'no snapshot yet in'} {out}; go on with --resume")
        raise SystemExit(INTERRUPTED) from None
    _say(
        f"wrote {SeriesFolder(out).collection}: {grown.snapshots} snapshots of {what.cells} cells, "
        f"{what.period:.4g} s apart; {grown.state.taken} steps, {grown.state.refused} refused; "
        f"volume within {100 * grown.volume:.2g} %, area within {100 * grown.area:.2g} %"
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr)
