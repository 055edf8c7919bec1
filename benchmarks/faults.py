"""Faults of all kinds, at random: what commands do when they are killed, have no room, or read what is no good.

python benchmarks/faults.py --trials 200 --csv docs/data/faults.csv

Each trial is one command (or two: the next one), counted as a traceback, a hang (more than 60 s of a processor, ten
times as long of waiting and, where it is killed, ten times what it takes undisturbed), a crash (a signal that nobody
sent), a wrong result taken silently, a file torn (half of it is left), something lost (a file that was whole before and
is no more, or a folder that no next command takes), or values of another file let in without leave. Trials are drawn
from the seed, and repeat with it but for moments of a kill by time; by turns a kill is before a change of files, whose
number is drawn.
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import machine
from fault_cost import Cost
from fault_files import flipped, hostile, odd, tampered, two
from fault_formats import formats, records
from fault_kills import full, killed
from fault_limits import denied, extreme, starved
from fault_places import foreign, outputs
from fault_shop import LOOKERS, WRITERS, Shop, Writer
from forked import loaded
from rows import read, write

OUTCOMES = ("traceback", "hang", "crash", "silent", "torn", "lost", "let in")
DISTURBED = ("kill -9", "full disk")
SINGLE: dict[str, Callable[[Shop, random.Random, Path], str]] = {
    "bit flips": flipped,
    "tampered runs": tampered,
    "hostile files": hostile,
    "odd values": odd,
    "two writers": two,
    "extreme kernels": extreme,
    "files of all formats": formats,
    "files of a run": records,
    "outputs over inputs": outputs,
    "values of other files": foreign,
}
LIMITED: dict[str, Callable[[Shop, Writer, random.Random, Path], str]] = {
    "no permission": denied,
    "little memory": starved,
}


def trials(
    shop: Shop, kind: str, count: int, rng: random.Random, writers: tuple[Writer, ...] = WRITERS, seconds: float = 1e9
) -> Counter:
    """`count` trials of a kind, or as many as begin within `seconds`: how many there were, and how many ended in each
    of `OUTCOMES`."""
    found, cost, begun = Counter[str](), {}, time.perf_counter()
    for number in range(count):
        if time.perf_counter() - begun > seconds:
            break
        several = (*writers, *LOOKERS) if kind in LIMITED and writers is WRITERS else writers
        writer = several[number % len(several)]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if kind in SINGLE:
                outcome = SINGLE[kind](shop, rng, folder)
            elif kind in LIMITED:
                outcome = LIMITED[kind](shop, writer, rng, folder)
            else:
                cost[writer.name] = cost.get(writer.name) or Cost.of(shop, writer)
                outcome = (full if kind == "full disk" else killed)(shop, writer, cost[writer.name], rng, folder)
        found.update(["trials", *([outcome] if outcome else [])])
        if outcome:
            print(f"{kind} {number} ({writer.name}): {outcome}", file=sys.stderr, flush=True)
    return found


def replaced(rows: list[dict[str, object]], row: dict[str, object]) -> list[dict[str, object]]:
    """The rows with a new one in place of that of its kind, or behind them."""
    kinds = [each["kind"] for each in rows]
    return [row if each["kind"] == row["kind"] else each for each in rows] + [row] * (row["kind"] not in kinds)


def main() -> None:
    """All kinds, and a table of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="of each kind")
    parser.add_argument("--kinds", nargs="*", default=[*DISTURBED, *LIMITED, *SINGLE])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="of each kind, at most")
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    loaded()
    with tempfile.TemporaryDirectory() as name:
        shop, rows = Shop.made(Path(name)), read(given.csv) if given.csv else []
        for kind in given.kinds:
            found = trials(shop, kind, given.trials, random.Random(f"{given.seed} {kind}"), seconds=given.seconds)
            row = {"kind": kind, "trials": found["trials"], **{name: found[name] for name in OUTCOMES}}
            row |= {"machine": f"{os.cpu_count()} × {platform.machine()}", "seed": given.seed}
            row["commit"] = machine.commit()
            print(row, flush=True)
            rows = replaced(rows, row)
            if given.csv:
                write(rows, given.csv)


if __name__ == "__main__":
    main()
