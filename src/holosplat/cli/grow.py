"""`holosplat grow`: cells carried and deformed by the flow through a channel, as a time series of meshes."""

from __future__ import annotations

from dataclasses import replace

from ..beamline.grow import Growth, SeriesFolder
from ..beamline.grow import grow as run
from ..io.lock import sole_writer
from ..planning.acts import of_growth
from ..planning.needs import Needs
from ..specimens.membrane.rest import nodes_of
from ..units import in_percent
from .places import Output
from .progress import ProgressBar
from .sentence import interruptible, say, tell


def grow(out: Output, what: Growth, resume: bool = False) -> None:
    """Let red cells flow through a channel, and write their meshes (VTK, µm) at every snapshot.

    Args:
        out: Folder to make: rbcCC_TTT.vtp for cell CC at snapshot TTT, and cells.pvd, which ParaView opens.
        resume: Go on with an interrupted run, or to more snapshots; --resume FOLDER alone, with its options.
    """
    what.check()
    coarser = ((f"--frequency {f}", _needs(replace(what, frequency=f))) for f in range(what.frequency - 1, 2, -1))
    tell("grow", _needs(what), out, coarser)
    with interruptible(lambda: _cut_off(SeriesFolder(out))), sole_writer(out), ProgressBar() as bar:
        grown = run(what, out, resume, bar.of("cells in flow"))
    wrote = out if what.compact else SeriesFolder(out).collection
    say(
        f"wrote {wrote}: {grown.snapshots} snapshots of {what.cells} cells, "
        f"{what.period:.4g} s apart; {grown.state.taken} steps, {grown.state.refused} refused; "
        f"volume within {in_percent(grown.volume)}, area within {in_percent(grown.area)}"
    )


def _cut_off(folder: SeriesFolder) -> str:
    kept = "snapshots so far stay in" if folder.state.is_file() else "no snapshot yet in"
    return f"interrupted; {kept} {folder.path}; go on with --resume"


def _needs(what: Growth) -> Needs:
    return of_growth(what.cells, nodes_of(what.frequency), what.snapshots, what.flow * what.period)
