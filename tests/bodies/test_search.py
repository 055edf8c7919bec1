"""Bodies of known rest shape in shadows: poses found by two beams, and sizes, on a raster of odd sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.motion_shadows import FLOW, OTHER, TURN, cell, pose, shadows
from holosplat.bodies import neighbourhood_search
from holosplat.bodies.neighbourhood_search import NeighbourhoodSearch, exchanged, pursued
from holosplat.bodies.poses import FREER, Explained, Pose
from holosplat.bodies.search import best_size
from holosplat.bodies.templates import Templates, TemplateSearch
from holosplat.fit.run import Run


def axis_error(found: Pose, turn: np.ndarray) -> float:
    """Angle between the cells' axes [degrees], of either sign."""
    axis = np.linalg.svd(found.matrix @ np.diag([1.0, 1.0, 0.3]))[0][:, 2]
    return float(np.degrees(np.arccos(min(1.0, abs(axis @ turn[:, 2])))))


def test_two_beams_find_a_body_and_its_pose(monkeypatch):
    """One cell that the frames cut at the end: centre, velocity and axis; the steps of another run give the same."""
    monkeypatch.setattr(neighbourhood_search, "PATIENCE", 1)
    truth = pose(TURN, (3.0, 11.0, -2.5), 1.1)
    flow, run = FLOW * np.array([0.9, 1.1])[:, None], Run()
    (found,), of_begun = pursued(cell(), shadows([truth]), flow, run=run)
    assert not of_begun
    with monkeypatch.context() as none:
        none.setattr(Explained, "_better", lambda *given: pytest.fail("these poses were made better before"))
        ((again,), _) = pursued(cell(), shadows([truth]), flow, run=Run(done=run.done))
    for name in ("matrix", "centre", "velocity", "turning"):
        assert np.array_equal(getattr(again, name), getattr(found, name))
    assert np.linalg.norm(found.centre - truth.centre) < 0.2
    assert np.linalg.norm(found.velocity - truth.velocity) < 0.2
    assert axis_error(found, TURN) < 5
    assert np.linalg.det(found.matrix) == pytest.approx(1)


def test_a_search_begins_with_what_is_known_where_that_explains_more(monkeypatch):
    """Cells that nothing but the start shows, for no place is tried; a start at ghosts is worth less than none."""
    truth = [pose(TURN, (6.0, 0.0, -5.0)), pose(OTHER, (-6.0, 1.0, 5.0), 1.2)]
    near = [replace(one, centre=one.centre + 0.8) for one in truth]
    astray = pose(TURN, (0.0, -18.0, 0.0))
    seen = shadows(truth)
    monkeypatch.setattr(neighbourhood_search, "PATIENCE", 1)
    assert not pursued(cell(), seen, FLOW[None], [astray])[1]
    monkeypatch.setattr(TemplateSearch, "tops", lambda *given: [])
    found, of_begun = pursued(cell(), seen, FLOW[None], [*near, astray])
    assert of_begun
    assert len(found) == 2
    for one in truth:
        assert min(np.linalg.norm(other.centre - one.centre) for other in found) < 0.3


@pytest.mark.parametrize("width", [32, 33])
def test_energies_of_templates_are_sums_over_all_frequencies(width):
    """Σ |F|² I / (H W) of whole spectra, of which half is kept; images are white, up to the highest frequency."""
    seen = shadows([pose(TURN, (0.0, 0.0, 0.0))])
    seen = replace(seen, thickness=seen.thickness[..., :width])
    images = torch.randn(4, 2, 6, 6, generator=torch.Generator().manual_seed(1))
    templates = Templates(np.tile(np.eye(3), (4, 1, 1)), images, np.array([0, 1] * 3), 2.5, 50.0)
    search = TemplateSearch(templates, seen, FLOW[None])
    columns = np.arange(search.size[1])
    for n, direction in enumerate(templates.directions):
        known = seen.information(n, search.size)[:, np.minimum(columns, search.size[1] - columns)]
        powers = torch.fft.fft2(images[:, direction], s=search.size).abs().square()
        wanted = (powers * known).sum((-1, -2)) / (search.size[0] * search.size[1])
        assert search.whole[n].numpy() == pytest.approx(wanted.numpy(), rel=1e-5)


def test_ghosts_are_exchanged_for_bodies():
    """Two cells at one height: each in the shadow of the one in the first beam, of the other in the second."""
    truth = [pose(TURN, (6.0, 0.0, -5.0)), pose(OTHER, (-6.0, 1.0, 5.0), 1.2)]
    seen = shadows(truth)
    every = Explained(cell(), seen)
    search = TemplateSearch(Templates.of(cell(), seen), seen, FLOW[None])
    ghosts = [pose(TURN, (6.0, 0.5, 5.0)), pose(OTHER, (-6.0, 0.5, -5.0))]
    found = exchanged(every, search, every.improved(ghosts, 8))
    for one in truth:
        assert min(np.linalg.norm(other.centre - one.centre) for other in found) < 0.5
    again = exchanged(every, search, truth)
    assert all(np.linalg.norm(a.centre - b.centre) < 0.2 for a, b in zip(again, truth))


def test_every_pair_at_one_height_is_exchanged(monkeypatch):
    """Three pairs of ghosts, of which one explains more than four fifths of its shadows; a search of few tries begins
    with that pair."""
    third = Rotation.from_rotvec([1.4, -0.6, 0.2]).as_matrix()
    truth, ghosts = list[Pose](), list[Pose]()
    for height, one, other in ((-14.0, TURN, OTHER), (0.0, OTHER, third), (14.0, third, TURN)):
        truth += [pose(one, (6.0, height, -5.0)), pose(other, (-6.0, height + 1, 5.0), 1.1)]
        ghosts += [pose(turn, (x, height + 0.5, x - np.sign(x))) for turn, x in ((one, 6.0), (other, -6.0))]
    seen = shadows(truth)
    every, search = Explained(cell(), seen, FREER), TemplateSearch(Templates.of(cell(), seen), seen, FLOW[None])
    begun = every.improved(ghosts, 8)
    assert every.shares(begun)[:2].min() > 0.8
    for name, value in (("PATIENCE", 1), ("TRIES", 1)):
        monkeypatch.setattr(neighbourhood_search, name, value)
    of_few = NeighbourhoodSearch(every, search).better([*begun[:2], *truth[2:]])
    for found in (exchanged(every, search, begun), of_few):
        assert len(found) == len(truth)
        for one in truth:
            assert min(np.linalg.norm(other.centre - one.centre) for other in found) < 0.2


def test_the_size_of_all_bodies_is_found():
    larger = replace(cell(), vertices=1.04 * cell().vertices)
    truth = [pose(TURN, (0.0, 2.0, 1.0))]
    assert best_size(cell(), shadows(truth, mesh=larger), truth, 0.1) == pytest.approx(1.04, abs=0.006)


def test_bins_and_projections_agree():
    """Thickness of the same bodies in larger pixels, of which an odd row is left over."""
    truth = [pose(TURN, (3.0, 2.0, -2.5))]
    seen = shadows(truth)
    seen = replace(seen, thickness=Explained(cell(), seen).images(truth))
    coarse = seen.binned(2)
    assert coarse.shape == (23, 16)
    small = replace(cell(), vertices=0.5 * cell().vertices)
    images = Explained(small, coarse).images([one.scaled(0.5) for one in truth])
    for one, other in zip(images, coarse.thickness):
        for axis in (0, 1):
            places = np.arange(one.shape[axis])
            middles = [image.sum(1 - axis) @ places / image.sum() for image in (one, other)]
            assert middles[0] == pytest.approx(middles[1], abs=0.15)  # the wrong way round: 0.5
    assert images.sum() == pytest.approx(coarse.thickness.sum(), rel=0.02)
