"""The card of the weights of the package: where they fail, as their ranges and docs/data/learned.csv say it.

    python benchmarks/card_of_weights.py

The weights themselves stay as they are. Run it again when docs/data/learned.csv has changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rows import read

from holosplat.learning.start import SHIPPED, Card, read_weights, write_weights
from holosplat.tables import from_table, to_table
from holosplat_bench.training.options import Ranges
from holosplat_bench.training.train import limits

RUNS = Path(__file__).resolve().parents[1] / "docs" / "data" / "learned.csv"
TAKEN = ("The run began with the", "start: network", "start: red cells")
"""First words of runs that began with the guess."""
NOISY, UNTOLD = "-noise", "-unknown"
"""Ends of the names of cases with photon noise, and of such whose material is not told."""


def said_of(card: Card) -> str:
    """Where the weights with `card` fail: by what they learnt from, and in whole runs."""
    known = {name: value for name, value in card.trained_on.items() if name != "seed"}
    ranges = from_table(Ranges, to_table(Ranges()) | known)  # older ones know neither of media nor of cores
    return f"{limits(ranges, card.training['shown']['views'], card.scores)} {in_runs(read(RUNS))}"


def in_runs(rows: Sequence[dict[str, str]]) -> str:
    """Where whole runs gain nothing by the guess, lose by it, or refuse it."""
    found = {(row["case"], row["scene"], row["views"], row["start"]): row for row in rows}
    with_it = {key[:3]: row for key, row in found.items() if key[3] == "learned"}
    begun = {key for key, row in with_it.items() if row["begun"].startswith(TAKEN)}
    refused = [key for key, row in with_it.items() if row["begun"].startswith("The frames contradict")]
    lost = [key for key in with_it if float(with_it[key]["dice"]) < float(found[(*key, "phase")]["dice"]) - 1e-3]
    noisy, untold = (_taken(with_it, begun, end) for end in (NOISY, UNTOLD))
    return (
        f"In whole runs (docs/data/{RUNS.name}) its guess was taken in {noisy} with noise in the frames and in "
        f"{untold} of matter that was not named. Frames contradicted its guesses of {_named(refused)}. "
        + (
            f"Runs that asked for it ended with a lower Dice coefficient of {_named(lost)}."
            if lost
            else "No run that asked for it ended with a lower Dice coefficient."
        )
    )


def _taken(runs: dict[tuple[str, ...], dict[str, str]], begun: set[tuple[str, ...]], end: str) -> str:
    these = [key for key in runs if key[0].endswith(end)]
    return f"{len(begun.intersection(these)) or 'none'} of {len(these)} runs"


def _named(runs: Sequence[tuple[str, ...]]) -> str:
    return ", ".join(f"{case} (scene {scene}, {views} views)" for case, scene, views in sorted(runs)) or "nothing"


if __name__ == "__main__":
    trained = read_weights()
    card = replace(trained.card, limits=said_of(trained.card))
    write_weights(SHIPPED, trained.network, card)
    print(card.limits)
