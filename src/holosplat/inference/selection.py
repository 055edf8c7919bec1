"""One way to choose: what a candidate predicts of frames that it has not seen, against the null, which wins ties."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..checks import require
from .score import Score

ERRORS = 2.0
"""Standard errors of the paired difference by which a candidate must predict better than the null."""
MARGIN = 0.02
"""Part of the residual that it must take away at least: less is no improvement in practice."""
LEAST = -math.log1p(-MARGIN)
"""The same as a gain."""


@dataclass(frozen=True)
class Compared:
    """A candidate beside the best one before it: by how much its residual is smaller (the logarithm of the ratio), and
    the standard error of that."""

    name: str
    gain: float
    error: float

    @property
    def wins(self) -> bool:
        """Whether the gain is sure and of practical size."""
        return self.gain > self._sure

    @property
    def loses(self) -> bool:
        """Whether a loss is."""
        return self.gain < -self._sure

    @property
    def likelier(self) -> bool:
        """Whether the gain is sure, of whatever size: enough where neither of the two is simpler or changes frames."""
        return self.gain > ERRORS * self.error

    @property
    def open(self) -> bool:
        """Whether the gain may yet be of practical size, as far as its error tells."""
        return self.gain + ERRORS * self.error > LEAST

    @property
    def large(self) -> bool:
        """Whether the gain is of practical size, sure or not."""
        return self.gain > LEAST

    @property
    def _sure(self) -> float:
        return max(ERRORS * self.error, LEAST)


@dataclass(frozen=True)
class Decision:
    """name: what was decided; choice: the candidate that was taken; by: how its score was found; compared: every
    candidate beside the null or what had won before; seconds: what it took"""

    name: str
    choice: str
    by: str
    compared: tuple[Compared, ...] = ()
    seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain values, which `from_dict` takes."""
        compared = [{"name": each.name, "gain": each.gain, "error": each.error} for each in self.compared]
        return {
            "name": self.name,
            "choice": self.choice,
            "by": self.by,
            "compared": compared,
            "seconds": self.seconds,
        }

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Decision:
        """The decision that `as_dict` wrote."""
        compared = tuple(
            Compared(str(each["name"]), float(each["gain"]), float(each["error"])) for each in table["compared"]
        )
        return cls(str(table["name"]), str(table["choice"]), str(table["by"]), compared, float(table["seconds"]))

    @property
    def line(self) -> str:
        """The same as a line of text."""
        tried = "; ".join(f"{each.name} {each.gain:+.1%} ± {each.error:.1%}" for each in self.compared)
        return f"{self.name}: {self.choice} ({self.by}{': ' if tried else ''}{tried})"


def select(
    name: str,
    candidates: Sequence[str],
    score: Callable[[str, int], Score],
    folds: int = 1,
    *,
    by: str,
    beside: Mapping[str, Sequence[str]] | None = None,
    surely: bool = True,
) -> Decision:
    """The candidate that predicts unseen frames best, by the policy of `Compared.wins`.

    candidates: the null first, then from simple to complex; score: of a candidate on the unseen frames of a fold, kept
    by the caller; folds: how many there are. Folds are looked at one after another, as long as the candidate may win by
    those before; it is taken only if it wins over all of them, where the frames, and not their blocks, give the
    standard error: frames differ by more than their parts do. by: how unseen frames came about; beside: other names
    that a candidate must win against, too. surely: whether a gain must be sure; where another score has told that, its
    size is enough.
    """
    require(len(candidates) > 0, "a selection needs at least one candidate, but there is none.")
    began, best, compared = time.perf_counter(), candidates[0], list[Compared]()
    for candidate in candidates[1:]:
        rivals = (best, *(beside or {}).get(candidate, ()))
        found = _least(candidate, rivals, score, range(1))
        for last in range(1, folds):
            if found.open:
                found = _least(candidate, rivals, score, range(last + 1))
        compared.append(found)
        if found.wins or (found.large and not surely):
            best = candidate
    return Decision(name, best, by, tuple(compared), round(time.perf_counter() - began, 2))


def _least(candidate: str, rivals: Sequence[str], score: Callable[[str, int], Score], folds: range) -> Compared:
    """The comparison with the strongest of the rivals, over some folds."""

    def joined(name: str) -> Score:
        return Score.joined([score(name, fold) for fold in folds])

    mine = joined(candidate)
    found = [Compared(candidate, *mine.gain_over(joined(rival))) for rival in rivals]
    return min(found, key=lambda each: each.gain - ERRORS * each.error)
