"""Commands that are killed, and commands on a disk that is full."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fault_cost import Cost
from fault_shop import Shop, Writer, hidden_in, is_whole, reads, snapshots
from forked import Ended, at_events, run

BLOCK = 4096
"""Bytes of a page, by which a file system in memory grows."""


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def killed(shop: Shop, writer: Writer, cost: Cost, rng: random.Random, folder: Path) -> str:
    """Kill a command, and let the next one follow; what went wrong. By turns at a random moment, and before a random
    change of files, between which most moments are alike."""
    command, limit = writer.command(shop, folder), cost.limit
    if cost.changes and rng.random() < 0.5:
        last = rng.randrange(cost.changes) + 1
        first = run(command, limit=limit, first=lambda: at_events(folder, lambda n: _die() if n == last else None))
    else:
        first = run(command, kill_after=rng.uniform(0.0, 1.1 * cost.seconds), limit=limit)
    if first.verdict:
        return first.verdict
    out = folder / writer.out
    if out.is_file() and not is_whole(out):
        return "lost"
    begun = any((out / name).is_file() for name in writer.begun) or not writer.begun
    done = writer.again and (first.code == 0 or ((out / "grow.json").is_file() and snapshots(out) == 4))
    if done:
        return ""
    at_once = writer.out != "run" and not writer.again and not writer.goes_on
    if at_once and out.exists():  # what is there is whole
        return "" if first.code == 0 or out.is_file() or reads(out) else "lost"
    again = writer.alone(out) if writer.alone else [*command, *writer.again]
    second = run(again if writer.again and begun else command, limit=limit)
    if second.verdict:
        return second.verdict
    if second.code != 0 or hidden_in(folder):
        return "lost"
    return "" if is_whole(out) else "lost"


def full(shop: Shop, writer: Writer, cost: Cost, rng: random.Random, folder: Path) -> str:
    """No room for all of it: one sentence, and what is there is whole. By turns no file grows beyond a random size, and
    a file system in memory is full, where one can be mounted (as root)."""
    largest = cost.largest
    if rng.random() < 0.5:
        ended = run(writer.command(shop, folder), file_size=rng.randrange(largest + 1))
        return _judged(ended, folder / writer.out)
    disk = folder / "disk"
    disk.mkdir()
    with _mounted(disk) as mounted:
        if not mounted:
            return _judged(run(writer.command(shop, disk), file_size=rng.randrange(largest + 1)), disk / writer.out)
        command = writer.command(shop, disk)  # which may put its input there
        used = sum(BLOCK * (1 + path.stat().st_size // BLOCK) for path in disk.rglob("*"))
        _mount("-o", f"remount,size={used + BLOCK + rng.randrange(largest + 1)}", disk)
        return _judged(run(command), disk / writer.out)


@contextmanager
def _mounted(disk: Path) -> Iterator[bool]:
    """A file system in memory at `disk`; False where it cannot be mounted."""
    if not _mount("-t", "tmpfs", "-o", "size=64m", "faults", disk):
        yield False
        return
    try:
        yield True
    finally:
        subprocess.run(["umount", str(disk)], check=True, capture_output=True)


def _mount(*arguments: object) -> bool:
    try:
        return subprocess.run(["mount", *map(str, arguments)], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def _judged(ended: Ended, out: Path) -> str:
    return sentence(ended) or ("lost" if out.is_file() and not is_whole(out) else "")


def sentence(ended: Ended) -> str:
    """What is wrong with how a command ended: it must work, or say one sentence."""
    if ended.verdict or ended.code == 0:
        return ended.verdict
    tidy = any(words in ended.said for words in ENDS) and not re.search(r"failed: \w*Error:", ended.said)
    return "" if tidy else "traceback"


ENDS = ("holosplat: ", "helptext", "holosplat series status|collect", "of these are wrong")
"""What the last words of a command are when it did not do all that it was asked for."""
