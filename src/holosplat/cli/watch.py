"""`holosplat watch`: scans reconstructed as they appear."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from tyro.conf import Positional

from ..checks import require
from ..io.reading import Reading
from ..ranges import Seed
from ..series.watch import Watch, WatchFolder, Watching
from ..tables import to_table
from .light import RunLightFlags
from .options import MethodOptions, PriorOptions
from .places import Kept
from .sentence import interruptible, say
from .series import Act, EachTime

HOW, EACH, LIGHT = Watching(), EachTime(), RunLightFlags()
"""What is done without options."""


def watch(
    folder: Positional[Path],
    out: Kept,
    how: Watching = HOW,
    each: EachTime = EACH,
    matter: PriorOptions = PriorOptions(),
    method: MethodOptions = MethodOptions(),
    reading: Reading = Reading(),
    *,
    illumination: RunLightFlags = LIGHT,
    seed: Seed = 0,
) -> None:
    """Reconstruct scans as they appear in a folder, each begun with what the last one gave, and keep a live page.

    The page is OUT/live.html, which a browser opens without a server. Ctrl-C ends the watch, and the same command goes
    on where it was.

    Args:
        folder: Folder to watch; files in it, not those of folders in it.
        out: Folder of the results, new or to go on with.
        seed: Seed of everything random.
    """
    require(not matter.ranges(), "a watch needs one number for --delta-beta; find it by reconstruct of one scan.")
    require(reading.part.time_frame is None, "a watch takes all times of a scan; choose some with --time-frames.")
    settings = Act(each, method, illumination=illumination).settings(track=False, seed=seed)
    said = {
        "folder": str(folder.resolve()),
        "settings": to_table(settings.as_table()),
        "matter": asdict(matter),
        "reading": reading.as_table(),
    }
    result = WatchFolder(out)
    say(f"watching {folder}; the page is {result.page}; Ctrl-C ends")
    with interruptible(lambda: f"ended; what {out} holds is whole, and the same command goes on from there"):
        count = Watch(folder, result, settings, matter.prior, reading, how, say).run(said)
    say(f"ended after {count} scan(s)")
