"""`holosplat dataset`: simulated scenes for learning, in a folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes

from ..ranges import Natural, Seed
from ..training.ranges import Ranges
from .progress import INTERRUPTED, ProgressBar

DRAWN = Ranges()
"""Red cells under ideal light."""


def dataset(
    out: Path,
    count: Natural = 1000,
    drawn: Annotated[Ranges, OmitArgPrefixes] = DRAWN,
    seed: Seed = 0,
    jobs: Natural = 1,
) -> None:
    """Simulate scenes for learning, drawn at random from stated ranges, into a folder of shards with a datasheet.

    The scene of a number and a seed is always the same; a folder that is there goes on with what it lacks.

    Args:
        out: Folder to make, or to go on with.
        count: Number of scenes.
        seed: Seed of the scenes.
        jobs: Processes that simulate.
    """
    from ..training.folder import Dataset
    from ..training.make import make

    wanted = Dataset(out, drawn, seed, count)
    with ProgressBar() as bar:
        try:
            made = make(wanted, jobs, lambda fraction: bar.show("scenes", fraction, {}))
        except KeyboardInterrupt:
            print(f"interrupted; {out} keeps its whole files, and the same command goes on", file=sys.stderr)
            raise SystemExit(INTERRUPTED) from None
    print(f"wrote {made} files of scenes; {out / 'datasheet.md'} says what they are")
