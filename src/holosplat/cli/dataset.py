"""`holosplat dataset`: simulated scenes for learning, in a folder."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

from ..ranges import Jobs, Seed, Within
from ..training.ranges import Ranges
from .places import Kept
from .progress import INTERRUPTED, ProgressBar
from .room import tell

if TYPE_CHECKING:
    from ..planning.needs import Needs

Layout = Literal["nerf-synthetic", "r2-gaussian", "onix"]
"""Those of `training.export`, which loads torch."""
DRAWN = Ranges()
"""Red cells under ideal light."""


def dataset(
    out: Kept,
    count: Annotated[int, Within(1, 10**6)] = 1000,
    drawn: Annotated[Ranges, OmitArgPrefixes] = DRAWN,
    seed: Seed = 0,
    jobs: Jobs = 1,
    layouts: Annotated[tuple[Layout, ...], arg(name="export")] = (),
) -> None:
    """Simulate scenes for learning, drawn at random from stated ranges, into a folder of shards with a datasheet.

    The scene of a number and a seed is always the same; a folder that is there goes on with what it lacks.

    Args:
        out: Folder to make, or to go on with.
        count: Number of scenes.
        seed: Seed of the scenes.
        jobs: Processes that simulate.
        layouts: Layouts of other programs into which the scenes are written too, each into a folder of its name in out.
    """
    from ..training.export import export
    from ..training.folder import Dataset, make_dataset

    wanted = Dataset(out, drawn, seed, count)
    left = sum(map(len, wanted.missing()))
    fewer = ((f"--jobs {n}", _needs(drawn, left, n)) for n in range(jobs - 1, 0, -1))
    tell("the dataset", _needs(drawn, left, jobs), out, fewer)
    with ProgressBar() as bar:
        try:
            made = make_dataset(wanted, jobs, lambda fraction: bar.show("scenes", fraction, {}))
        except KeyboardInterrupt:
            print(f"interrupted; {out} keeps its whole files, and the same command goes on", file=sys.stderr)
            raise SystemExit(INTERRUPTED) from None
        done = [
            export(wanted, layout, lambda part, layout=layout: bar.show(f"{layout} files", part, {}))
            for layout in layouts
        ]
    print(f"wrote {made} files of scenes; {out / 'datasheet.md'} says what they are")
    for each in done:
        left_out = f"; left out, for their views have no common axis: {len(each.left_out)}" if each.left_out else ""
        print(f"wrote {each.count} scene{'s' * (each.count > 1)} into {each.folder}{left_out}")


def _needs(drawn: Ranges, scenes: int, jobs: int) -> Needs:
    """What so many scenes take."""
    from ..beamline.simulate import Simulation
    from ..planning.acts import of_dataset
    from ..planning.needs import of_simulation

    views = drawn.views + drawn.held_out
    ends = (of_simulation(each, Simulation().samples(each), views) for each in drawn.extremes())
    return of_dataset(max(ends, key=lambda needs: needs.memory), (drawn.rows, drawn.columns), views, scenes, jobs)
