"""The one score and the one policy: what a candidate leaves of unseen frames by octaves, and when it is taken."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.inference import ERRORS, MARGIN, Compared, Decision, Score, select

SHAPES = [(64, 96), (51, 73), (9, 33), (1, 40)]


def noise(shape: tuple[int, ...], seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("shape", SHAPES)
def test_white_noise_has_the_same_power_in_all_octaves(shape):
    powers = Score.of(0.3 * noise((40, *shape))).powers
    assert powers.mean(axis=0) == pytest.approx(0.09, rel=0.12)


@pytest.mark.parametrize("shape", SHAPES[:2])
def test_the_gain_is_the_logarithm_of_the_residuals_ratio(shape):
    residual = noise((4, *shape))
    gain, error = Score.of(0.5 * residual).gain_over(Score.of(residual))
    assert gain == pytest.approx(math.log(2))
    assert error == pytest.approx(0, abs=1e-12)


def test_every_octave_counts_alike():
    """A change of the coarsest octave alone, which has a thousandth of the pixels' information, is seen."""
    residual = noise((4, 64, 96))
    blocks = residual.unflatten(2, (-1, 32)).unflatten(1, (-1, 32)).mean(dim=(2, 4), keepdim=True)
    less = residual - 0.5 * blocks.expand(4, 2, 32, 3, 32).reshape(4, 64, 96)
    octaves = Score.of(residual).powers.shape[1]
    gain, _ = Score.of(less).gain_over(Score.of(residual))
    assert gain == pytest.approx(math.log(2) / octaves, rel=1e-6)


def test_the_error_is_that_of_repeated_draws():
    gains, errors = [], []
    for seed in range(60):
        first, second = noise((6, 64, 64), 2 * seed), noise((6, 64, 64), 2 * seed + 1)
        gain, error = Score.of(first).gain_over(Score.of(second))
        gains.append(gain)
        errors.append(error)
    assert np.mean(errors) == pytest.approx(np.std(gains), rel=0.35)
    assert abs(np.mean(gains)) < 3 * np.std(gains) / 60**0.5


def test_joined_scores_have_one_block_a_frame():
    parts = [Score.of(noise((2, 64, 64), seed)) for seed in range(3)]
    joined = Score.joined(parts)
    assert joined.powers.shape == (6, parts[0].powers.shape[1])
    assert joined.powers.mean(axis=0) == pytest.approx(np.concatenate([p.powers for p in parts]).mean(axis=0))
    assert Score.joined(parts[:1]) is parts[0]


@pytest.mark.parametrize(
    ("gain", "error", "wins"),
    [(0.1, 0.01, True), (0.1, 0.051, False), (0.019, 0.0, False), (0.021, 0.0, True), (-0.5, 0.0, False)],
)
def test_a_candidate_wins_by_two_errors_and_two_per_cent(gain, error, wins):
    assert (ERRORS, MARGIN) == (2.0, 0.02)
    assert Compared("other", gain, error).wins == wins


def residuals(factors: dict[str, tuple[float, ...]]):
    """Scores of candidates whose residual in each fold is that of the null times a factor."""
    return lambda name, fold: Score.of(factors[name][fold] * noise((2, 64, 64), fold))


def test_the_null_wins_ties_and_the_simpler_candidate_too():
    same = residuals({"null": (1.0,), "first": (1.0,), "second": (0.9,), "third": (0.895,)})
    found = select("name", ["null", "first", "second", "third"], same, by="views set aside")
    assert found.choice == "second"
    assert [each.wins for each in found.compared] == [False, True, False]
    assert found.compared[2].gain == pytest.approx(math.log(0.9 / 0.895), rel=1e-6)  # beside the second


def test_what_wins_in_one_fold_by_frames_that_differ_must_win_over_all():
    asked, uneven = [], torch.tensor([0.5, 0.85])[:, None, None]  # gains of .69 and .16

    def score(name, fold):
        asked.append((name, fold))
        factor = 1.0 if name == "null" else (uneven, 2.5, 1.0)[fold]
        return Score.of(factor * noise((2, 64, 64), fold))

    found = select("name", ["null", "other"], score, 3, by="views set aside")
    assert found.choice == "null"
    assert ("other", 1) in asked
    assert ("other", 2) not in asked  # it had lost by then


@pytest.mark.parametrize("second", [0.61, 0.66, 0.75])
def test_a_candidate_wins_early_by_more_errors_than_in_the_end(second):
    """Two frames of gains a and b have the mean (a + b) / 2 and the error |a - b| / 2. After one fold of three a
    candidate needs 13.97 errors (Student's t of one degree of freedom, at the probability of two errors) times √3."""
    asked, uneven = set(), torch.tensor([0.6, second])[:, None, None]

    def score(name, fold):
        asked.add(fold)
        return Score.of((1.0 if name == "null" else uneven) * noise((2, 96, 64), fold))

    assert select("name", ["null", "other"], score, 3, by="views set aside").choice == "other"
    a, b = -math.log(0.6), -math.log(second)
    least = -math.log1p(-MARGIN)
    assert ((a + b) / 2 - 13.97 * math.sqrt(3) * abs(a - b) / 2 > least) == (asked == {0})


def test_few_frames_do_not_tell_their_own_scatter():
    """Gains of four frames that alternate have 3.5 errors, more than the 2.45 of a bound by many frames, and fewer than
    the 4.05 by four: the third fold is looked at, and speaks against the candidate."""
    gains = (0.12, 0.04, 0.12, 0.04)
    error = 0.04 / math.sqrt(3)
    assert 2 * math.sqrt(3 / 2) < 0.08 / error < 3.308 * math.sqrt(3 / 2)

    def score(name, fold):
        own = torch.tensor([gains[2 * fold], gains[2 * fold + 1]] if fold < 2 else [-0.3, -0.1])
        factor = 1.0 if name == "null" else torch.exp(-own)[:, None, None]
        return Score.of(factor * noise((2, 96, 64), fold))

    assert select("name", ["null", "other"], score, 2, by="views set aside").choice == "other"
    assert select("name", ["null", "other"], score, 3, by="views set aside").choice == "null"


def test_a_gain_of_little_more_than_practical_size_does_not_win_early():
    """A sure gain of .028 in two frames of a fold, whose error is .0004, may be less than .0202 over all: it is here,
    for the second fold gains nothing."""
    gains = ((0.0284, 0.0276), (0.004, 0.004))
    assert 13.97 * math.sqrt(2) * 0.0004 < 0.028
    assert 0.028 - 13.97 * math.sqrt(2) * 0.0004 < -math.log1p(-MARGIN)

    def score(name, fold):
        factor = 1.0 if name == "null" else torch.exp(-torch.tensor(gains[fold]))[:, None, None]
        return Score.of(factor * noise((2, 96, 64), fold))

    assert select("name", ["null", "other"], score, 1, by="views set aside").choice == "other"
    assert select("name", ["null", "other"], score, 2, by="views set aside").choice == "null"


@pytest.mark.parametrize("against", ["null", "rival"])
def test_blocks_and_rivals_must_speak_for_an_early_end_too(against):
    """Two frames of the same mean, whose blocks differ: the second fold is looked at. So it is where the null is beaten
    evenly, and another name that must be, not."""
    asked, uneven = set(), torch.tensor([0.3, 0.9]).repeat_interleave(32)[None, None, :]

    def score(name, fold):
        asked.add(fold)
        whole = noise((1, 64, 64), fold).expand(2, -1, -1)
        other, rival = (uneven, 1.0) if against == "null" else (0.4, 0.3 + 0.3 * uneven)
        return Score.of({"null": 1.0, "other": other, "rival": rival}[name] * whole)

    select("name", ["null", "other"], score, 3, by="views", beside={"other": ["rival"]})
    assert asked > {0}


def test_what_one_fold_leaves_open_all_of_them_decide():
    """Two frames of which one alone is halved tell nothing; eight, seven of which are halved, do."""
    uneven = torch.tensor([0.5, 1.05])[:, None, None]

    def score(name, fold):
        factor = 1.0 if name == "null" else uneven if fold == 0 else 0.5
        return Score.of(factor * noise((2, 32, 32), fold))

    assert select("name", ["null", "other"], score, 1, by="views").choice == "null"
    assert select("name", ["null", "other"], score, 4, by="views").choice == "other"


def test_a_candidate_that_cannot_win_is_not_followed():
    """A residual of .995 times the null's in every block is less than the margin, whatever other folds say."""
    asked = []

    def score(name, fold):
        asked.append((name, fold))
        return residuals({"null": (1.0, 1.0), "other": (0.995, 0.5)})(name, fold)

    assert select("name", ["null", "other"], score, 2, by="views set aside").choice == "null"
    assert ("other", 1) not in asked


def test_a_gain_that_another_score_has_shown_needs_practical_size_only():
    unsure = torch.tensor([0.4, 1.2])[:, None, None]

    def score(name, fold):
        factor = {"null": 1.0, "other": unsure, "alike": 0.99}[name]
        return Score.of(factor * noise((2, 32, 32), fold))

    asked = {"by": "views", "surely": False}
    assert select("light", ("null", "other"), score, by="views").choice == "null"
    assert select("light", ("null", "other"), score, **asked).choice == "other"
    assert select("light", ("null", "alike"), score, **asked).choice == "null"


def test_a_gain_whose_size_another_score_has_shown_needs_to_be_sure_only():
    score = residuals({"null": (1.0, 1.0), "other": (0.99, 0.99), "worse": (1.01, 1.01)})
    asked = {"by": "data fission", "least": 0.0}
    assert select("bodies", ("null", "other"), score, 2, by="views").choice == "null"
    found = select("bodies", ("null", "other"), score, 2, **asked)
    assert found.choice == "other"
    assert Decision.from_dict(found.as_dict()) == found
    assert select("bodies", ("null", "worse"), score, 2, **asked).choice == "null"


def test_after_a_rival_that_wins_no_other_is_asked_for():
    score = residuals({"null": (1.0,), "other": (1.2,)})
    assert select("name", ["null", "other"], score, by="x", beside={"other": ("never made",)}).choice == "null"


def test_rivals_beside_the_null_must_be_beaten_too():
    score = residuals({"null": (1.0,), "free": (0.5,), "other": (0.7,)})
    assert select("name", ["null", "other"], score, by="x").choice == "other"
    assert select("name", ["null", "other"], score, by="x", beside={"other": ("free",)}).choice == "null"


def test_a_decision_comes_back_from_plain_values():
    found = Decision("light", "as measured", "views set aside", (Compared("uneven", -0.3, 0.1),), 1.5)
    assert Decision.from_dict(found.as_dict()) == found
    assert found.line == "light: as measured (views set aside: uneven -30.0% ± 10.0%)"


def test_a_selection_of_nothing_is_refused():
    with pytest.raises(InputError, match="at least one candidate"):
        select("name", [], residuals({}), by="x")
