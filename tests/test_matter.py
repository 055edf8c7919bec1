"""What is known of the matter must be said."""

from __future__ import annotations

import copy
import pickle

import pytest

from holosplat import MaterialPrior
from holosplat.checks import InputError
from holosplat.materials import DeltaBeta

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


def test_only_where_nothing_is_known_is_the_ratio_open():
    assert [name for name, prior in KINDS.items() if not prior.fixes_ratio] == ["nothing"]
