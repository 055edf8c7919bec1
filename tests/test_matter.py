"""What is known of the matter must be said."""

from __future__ import annotations

import copy
import pickle

import pytest

from holosplat import MaterialPrior
from holosplat.checks import InputError
from holosplat.materials import DeltaBeta
from holosplat.series.plan import prior_of

SOFT, BONE = DeltaBeta(1e-7, 1e-10), DeltaBeta(5e-7, 5e-9)
KINDS = {
    "one": MaterialPrior.known(SOFT),
    "two": MaterialPrior.known(SOFT, BONE),
    "ratio": MaterialPrior.of_ratio(1000),
    "nothing": MaterialPrior.unknown(),
}


def test_what_is_known_must_be_said():
    with pytest.raises(InputError, match=r"must be said by MaterialPrior.known.*it is MaterialPrior\(\); take one"):
        MaterialPrior()


@pytest.mark.parametrize("prior", KINDS.values(), ids=KINDS)
def test_what_is_known_survives_copies_and_pickles(prior):
    assert copy.deepcopy(prior) == prior == pickle.loads(pickle.dumps(prior))


def test_what_is_told_of_the_sign_is_known():
    assert [prior.sign for prior in KINDS.values()] == [1, 1, 0, 0]
    holes = MaterialPrior.known(DeltaBeta(-1e-7, 2e-10), DeltaBeta(-5e-7, -5e-9))
    assert holes.materials == ((-5e-7, -5e-9), (-1e-7, 2e-10))  # the stronger contrast first
    assert (holes.sign, holes.against) == (-1, "the medium")
    assert MaterialPrior.known(SOFT, medium="water").against == "water"
    assert MaterialPrior.known(SOFT).against == ""
    below = MaterialPrior.of_ratio(1000).signed(-1)
    assert (below.sign, below.delta_sign, below.as_dict()["sign"]) == (-1, -1.0, -1)
    assert "sign" not in MaterialPrior.of_ratio(1000).as_dict()
    assert prior_of(below.as_dict()) == below
    assert prior_of(MaterialPrior.known(DeltaBeta(-1e-7, 0.0), medium="oil").as_dict()).medium == "oil"


@pytest.mark.parametrize(("index", "name"), [((float("nan"), 0.0), "δ"), ((1e-7, float("-inf")), "β")])
def test_an_index_is_finite(index, name):
    with pytest.raises(InputError, match=f"{name} must be a finite number, but it is"):
        DeltaBeta(*index)


def test_several_materials_are_the_same_in_a_file():
    first, near, last = DeltaBeta(9e-7, 2e-9), DeltaBeta(8.6e-7, 1e-9), DeltaBeta(2e-7, 1e-10)
    several = MaterialPrior.known(last, near, first)
    assert several.materials == (first, near, last)
    assert prior_of(several.as_dict()) == several
    old = {"kind": "known", "delta": first.delta, "beta": first.beta}
    old |= {"second_delta": last.delta, "second_beta": last.beta}
    assert prior_of(old).materials == (first, last)


def test_what_cannot_be_seen_or_told_apart_is_refused():
    with pytest.raises(InputError, match="must differ from its medium in δ, but the difference is 0"):
        MaterialPrior.known(DeltaBeta(0.0, 1e-9))
    with pytest.raises(InputError, match="told apart by δ, but theirs are"):
        MaterialPrior.known(DeltaBeta(-1e-7, 0.0), DeltaBeta(-1e-7, -1e-9))
    with pytest.raises(InputError, match="sign must be -1, 0 or 1"):
        prior_of(MaterialPrior.unknown().as_dict() | {"sign": 2})
    assert MaterialPrior.of_ratio(1e6).ratio == 1e6
    with pytest.raises(InputError, match=r"size between 1 and 1e\+06, but it is 1\.1e\+06"):
        MaterialPrior.of_ratio(1.1e6)


def test_known_materials_may_lie_on_both_sides_of_their_medium():
    """The stronger one comes first, whichever side that is."""
    holes = DeltaBeta(-2 * SOFT.delta, -5e-9)
    both, one = (
        MaterialPrior.known(SOFT, holes, medium="water"),
        MaterialPrior.known(SOFT, DeltaBeta(2 * SOFT.delta, SOFT.beta)),
    )
    assert both.materials == (holes, SOFT)
    assert (both.sign, both.two_sided, one.two_sided) == (-1, True, False)
    assert both.on_both_sides() is both
    assert prior_of(both.as_dict()) == both
    with pytest.raises(InputError, match="must be of one --material, but there are several"):
        one.on_both_sides()


def test_only_where_nothing_is_known_is_the_ratio_open():
    assert [name for name, prior in KINDS.items() if not prior.fixes_ratio] == ["nothing"]
