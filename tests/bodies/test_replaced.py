"""The search that takes bodies away and looks for others: what it puts together, and what it gets out of."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from helpers.motion_shadows import FLOW, OTHER, TURN, cell, pose, shadows
from holosplat.bodies import neighbourhood_search
from holosplat.bodies.neighbourhood_search import NeighbourhoodSearch, Pool, best_choice
from holosplat.bodies.poses import FREER, Explained
from holosplat.bodies.templates import Templates, TemplateSearch


def test_a_choice_is_the_best_of_all():
    """Eleven candidates, whose 2048 choices are all looked at."""
    draws = np.random.default_rng(3)
    images = draws.random((11, 23)) * (draws.random((11, 23)) < 0.4)
    products, gains = images @ images.T, images @ (images[[1, 4, 8]].sum(0) + 0.1 * draws.normal(size=23)) - 0.01
    choices = np.array(list(product((0, 1), repeat=11)))
    costs = 0.5 * np.einsum("ni,ij,nj->n", choices, products, choices) - choices @ gains
    found = best_choice(products, gains)
    np.testing.assert_array_equal(found, choices[costs.argmin()].astype(bool))


def test_equal_candidates_are_not_exchanged_for_ever():
    """Rounding makes each of two equal candidates better than the other by 1e-12."""
    r = np.random.default_rng(0)
    shadows = r.random((int(r.integers(4, 9)), 5)).astype(np.float32)
    shadows = np.concatenate([shadows, shadows[:3], shadows[:2]])
    products = (shadows @ shadows.T).astype(float) / 0.013**2
    gains = shadows @ shadows[:3].sum(axis=0) / 0.013**2 - 0.1
    found = best_choice(products, gains)
    assert 0.5 * found @ products @ found - gains @ found < 0


def test_the_best_of_several_tries_are_put_together():
    """Each try has one body right and one astray; the pool has them all."""
    truth = [pose(TURN, (6.0, 0.0, -5.0)), pose(OTHER, (-6.0, 1.0, 5.0), 1.2)]
    every = Explained(cell(), shadows(truth))
    pool = Pool(every)
    assert pool.chosen() == []
    pool.add([truth[0], pose(TURN, (-6.0, 0.0, -5.0))])
    pool.add([pose(OTHER, (6.0, 1.0, 5.0)), truth[1]])
    assert {id(one) for one in pool.chosen()} == {id(one) for one in truth}


def test_a_body_that_stands_for_two_is_replaced_by_them(monkeypatch):
    """It lies between two cells that cross in the first beam; from there no small step is better."""
    monkeypatch.setattr(neighbourhood_search, "PATIENCE", 1)
    truth = [pose(TURN, (1.0, 0.0, -7.0)), pose(OTHER, (-1.0, 1.0, 7.0), 1.1)]
    seen = shadows(truth)
    every = Explained(cell(), seen)
    search = TemplateSearch(Templates.of(cell(), seen), seen, FLOW[None])
    begun = every.improved([pose(TURN, (0.0, 0.5, 0.0))], 15)
    heard: list[float] = []
    found = NeighbourhoodSearch(every, search, 1).better(begun, on_progress=heard.append)
    assert len(found) == 2
    for one in truth:
        assert min(np.linalg.norm(other.centre - one.centre) for other in found) < 0.5
    assert every.value(found) < every.value(begun)
    assert 0 == heard[0] <= max(heard) < 1


def test_nothing_becomes_nothing():
    seen = shadows([])
    every = Explained(cell(), seen)
    assert NeighbourhoodSearch(every, TemplateSearch(Templates.of(cell(), seen), seen, FLOW[None])).better([]) == []


def test_doubts_are_where_something_is_missing():
    """Two cells apart, of which the second one is astray by half its radius."""
    truth = [pose(TURN, (6.0, 10.0, -5.0)), pose(OTHER, (-6.0, -9.0, 5.0), 1.2)]
    every = Explained(cell(), shadows(truth))
    shares = every.shares(truth)
    assert shares == pytest.approx([1, 1], abs=0.02)
    astray = [truth[0], pose(OTHER, (-6.0, -7.0, 5.0), 1.2)]
    doubts = every.doubts(astray)
    assert doubts[1] > 5 * doubts[0]
    assert every.doubts(truth).max() < 0.1


def test_strains_cost_less_in_the_end():
    seen = shadows([pose(np.diag([1.2, 1.0, 1 / 1.2]), (0.0, 0.0, 0.0))])
    longer = [pose(np.diag([1.2, 1.0, 1 / 1.2]), (0.0, 0.0, 0.0))]
    strains = [Explained(cell(), seen, *strain).strained(longer) for strain in ((), (FREER,))]
    assert strains[1] == pytest.approx(strains[0] / 20)
    left = Explained(cell(), seen)
    assert left.value(longer) == pytest.approx(strains[0] + float(left.cost(seen.thickness - left.images(longer))))


def test_a_body_in_front_of_a_missing_one_is_doubtful():
    """It explains its own shadow, and what is left lies there, too."""
    truth = [pose(TURN, (1.0, 0.0, -7.0)), pose(OTHER, (-1.0, 1.0, 7.0), 1.1)]
    every = Explained(cell(), shadows(truth))
    assert every.shares(truth[:1])[0] > 0.95
    assert every.doubts(truth[:1])[0] > 0.2 > 3 * every.doubts(truth)[0]
