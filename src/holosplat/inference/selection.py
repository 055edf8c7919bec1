"""One way to choose: by the predictive score, how much of measured frames that it has not seen a prediction leaves,
octave by octave and block by block, against the null, which wins ties."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import require

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 32
"""Edge of the blocks [pixels], at most, whose scatter gives the standard error within a frame: on frames of some 80
pixels, residuals correlate over the bodies that cause them."""
SMALLEST = 1e-12
"""Part of the largest power that every power has at least, against the logarithm of zero."""


@dataclass(frozen=True)
class Score:
    """What a prediction leaves of frames that it has not seen.

    powers: [B, K] float64: mean square residual of each of B blocks in each of K octaves of spatial frequency, the
    finest first; the last octave holds everything coarser than a block
    frames: number of frames, of which each has B / frames blocks
    """

    powers: np.ndarray
    frames: int = 1

    @classmethod
    def of(cls, residual: Tensor) -> Score:
        """Of residuals [V, H, W]: powers of the Haar wavelets (Haar 1910) in square blocks of `BLOCK` pixels.

        The wavelets of a block lie within it, so that blocks share nothing. Small frames have smaller blocks; what
        remains of rows and columns is left out at both sides.
        """
        import torch

        edge = BLOCK
        while edge > 2 and min(residual.shape[1:]) < 2 * edge:
            edge //= 2
        if min(residual.shape[1:]) < edge:
            edge = 1
        rows, columns = (slice((n % edge) // 2, (n % edge) // 2 + n // edge * edge) for n in residual.shape[1:])
        level = residual.detach().cpu().double()[:, rows, columns]
        bands: list[Tensor] = []
        size = edge
        while size > 1:
            quads = level.unflatten(2, (-1, 2)).unflatten(1, (-1, 2))
            mean = quads.mean(dim=(2, 4))
            detail = (quads - mean[:, :, None, :, None]).square().sum(dim=(2, 4)) / 3
            half = size // 2
            bands.append(torch.nn.functional.avg_pool2d(detail[None], half)[0].flatten() * (edge // size) ** 2)
            level, size = mean, half
        bands.append(level.square().flatten() * edge**2)
        return cls(torch.stack(bands, dim=1).numpy(), len(residual))

    @classmethod
    def joined(cls, scores: Sequence[Score]) -> Score:
        """The score of several sets of frames, with one block a frame; of one set the same."""
        if len(scores) == 1:
            return scores[0]
        return cls(np.concatenate([one.by_frames.powers for one in scores]), sum(one.frames for one in scores))

    @property
    def by_frames(self) -> Score:
        """The same with one block a frame."""
        return Score(self.powers.reshape(self.frames, -1, self.powers.shape[1]).mean(axis=1), self.frames)

    def gain_over(self, other: Score) -> tuple[float, float]:
        """How much smaller the residual is than that of `other`, and the standard error of this.

        The gain is the log-likelihood with the variance of each octave profiled, `½ log P`, in the mean over octaves:
        the logarithm of the ratio of residuals. Octaves count alike, whereas pixels are nearly all of the finest one,
        and matter shows itself in all. The error is that of the delete-one jackknife (Efron & Stein 1981) over blocks,
        of the paired difference.
        """
        mine, theirs = (one.powers for one in (self, other))
        sums = mine.sum(axis=0), theirs.sum(axis=0)
        gain = float(self._log_ratio(*sums))
        count = len(mine)
        if count < 2:
            return gain, float("inf")
        without = self._log_ratio(sums[0] - mine, sums[1] - theirs)
        error = float(np.sqrt((count - 1) / count * np.square(without - without.mean()).sum()))
        return gain, error

    def _log_ratio(self, mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
        return 0.5 * np.log(self._means(theirs) / self._means(mine)).mean(axis=-1)

    @staticmethod
    def _means(powers: np.ndarray) -> np.ndarray:
        largest = powers.max(axis=-1, keepdims=True)
        return np.maximum(powers, np.maximum(SMALLEST * largest, np.finfo(float).tiny))


ERRORS = 2.0
"""Standard errors of the paired difference by which a candidate must predict better than the null."""
MARGIN = 0.02
"""Part of the residual that it must take away at least: less is no improvement in practice."""
LEAST = -math.log1p(-MARGIN)
"""The same as a gain."""


@dataclass(frozen=True)
class Compared:
    """A candidate beside the best one before it: by how much its residual is smaller (the logarithm of the ratio), and
    the standard error of that; least: the gain that has practical size."""

    name: str
    gain: float
    error: float
    least: float = LEAST

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
        return self.gain + ERRORS * self.error > self.least

    @property
    def large(self) -> bool:
        """Whether the gain is of practical size, sure or not."""
        return self.gain > self.least

    @property
    def _sure(self) -> float:
        return max(ERRORS * self.error, self.least)


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
        return asdict(self)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Decision:
        """The decision that `as_dict` wrote."""
        compared = tuple(
            Compared(str(each["name"]), float(each["gain"]), float(each["error"]), float(each.get("least", LEAST)))
            for each in table["compared"]
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
    least: float = LEAST,
) -> Decision:
    """The candidate that predicts unseen frames best, by the policy of `Compared.wins`.

    candidates: the null first, then from simple to complex; score: of a candidate on the unseen frames of a fold,
    kept by the caller; folds: how many there are. Folds are looked at one after another, as long as those before
    leave the candidate open: it may win by them, and has not won early. The frames, and not their blocks, give the
    standard error over several folds: frames differ by more than their parts do. After k of K folds a candidate wins
    early if its gain is of practical size even less √(K/k) times as many errors as count in the end (O'Brien &
    Fleming 1979), and more by Student's t, for few frames do not tell their own scatter; both frames and blocks must
    say so. by: how unseen frames came about; beside: other names that a candidate must win against, too. surely,
    least: whether a gain must be sure, and the practical size that it must have. Where another score has told that it
    is sure, its size is enough; where another has told its size (`least` is 0), it need only be sure.
    """
    require(len(candidates) > 0, "a selection needs at least one candidate, but there is none.")
    began, best, compared = time.perf_counter(), candidates[0], list[Compared]()
    for candidate in candidates[1:]:
        rivals = (best, *(beside or {}).get(candidate, ()))
        found = _weakest(candidate, rivals, score, range(1), least)
        for looked in range(1, folds):
            if not found.open or _wins_early(candidate, rivals, score, (looked, folds), least):
                break
            found = _weakest(candidate, rivals, score, range(looked + 1), least)
        compared.append(found)
        if found.wins or (found.large and not surely):
            best = candidate
    return Decision(name, best, by, tuple(compared), round(time.perf_counter() - began, 2))


def _weakest(
    candidate: str, rivals: Sequence[str], score: Callable[[str, int], Score], folds: range, least: float
) -> Compared:
    """The comparison with the strongest of the rivals, over some folds; or with the first that it cannot win against,
    after which no other need be made."""

    def joined(name: str) -> Score:
        return Score.joined([score(name, fold) for fold in folds])

    mine, found = joined(candidate), list[Compared]()
    for rival in rivals:
        found.append(Compared(candidate, *mine.gain_over(joined(rival)), least))
        if not found[-1].open:
            return found[-1]
    return min(found, key=lambda each: each.gain - ERRORS * each.error)


def _wins_early(
    candidate: str, rivals: Sequence[str], score: Callable[[str, int], Score], looked: tuple[int, int], least: float
) -> bool:
    """Whether a candidate wins against all rivals by the first folds of several; looked: their number, and of all."""
    from scipy.special import ndtr, stdtrit

    first, every = looked
    for rival in rivals:
        mine, theirs = (Score.joined([score(name, fold) for fold in range(first)]) for name in (candidate, rival))
        for one, other in ((mine, theirs), (mine.by_frames, theirs.by_frames)):
            gain, error = one.gain_over(other)
            few = stdtrit(max(1, len(one.powers) - 1), ndtr(ERRORS)) / ERRORS
            if not gain - few * ERRORS * math.sqrt(every / first) * error > least:
                return False
    return True
