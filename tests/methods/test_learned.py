"""A network's guess beside phase retrieval: what is begun with, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import holosplat as hs
from holosplat.baselines import HolographicTV
from holosplat.learning.lattice import Taps
from holosplat.learning.start import LearnedStart
from holosplat.learning.weights import Card, Trained
from holosplat.methods import Gaussians, Surfaces, Task
from holosplat.methods.beginning import Beginning
from holosplat.methods.coarse import CoarseToFine
from holosplat.methods.cross_validation import MissingMatter
from holosplat.methods.evidence import Evidence
from holosplat.methods.gaussians import GaussianStage
from holosplat.methods.illumination import prepared
from holosplat.methods.learned import _Trial
from holosplat.methods.method import solve_stages
from holosplat.methods.start import starting_cloud
from holosplat.optics.noise_model import NoiseModel
from holosplat.representations import GaussianCloud, SurfaceMesh
from holosplat.specimens import Ball

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
KNOWN = hs.MaterialPrior.known(MATERIAL)
PIXEL = 0.4e-6
CENTRE, RADIUS = np.array([1.2e-6, -0.6e-6, -0.8e-6]), 2.2e-6
OPTIONS = Gaussians(
    start="learned",
    approximate_steps=10,
    volume=HolographicTV(retrieval=10, iterations=20, corrections=1, inner=5),
    learned=LearnedStart(trial_steps=4, trial_surfaces=3, last_steps=6, last_surfaces=4),
)


class Says(nn.Module):
    """Says that there is a ball, in the right place or beside it."""

    def __init__(self, aside: float) -> None:
        super().__init__()
        self.aside = aside

    def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
        """Logits of the ball on voxels of a pixel."""
        z, y, x = (PIXEL * (torch.arange(2 * n) - n + 0.5) for n in taps.grid)
        place = CENTRE + [self.aside, 0, 0]
        away = (x - place[0]) ** 2 + (y[:, None] - place[1]) ** 2 + (z[:, None, None] - place[2]) ** 2
        logits = 20 * (RADIUS - away.sqrt()) / PIXEL
        return logits, logits


@pytest.fixture(scope="module")
def scan() -> hs.Scan:
    views = hs.Views.from_angles(np.array([0.0, 70.0]), (24, 26), PIXEL)
    ball = hs.MeshScene.of_one_material([Ball(CENTRE, 2 * RADIUS).mesh()], MATERIAL)
    return hs.simulate(ball, hs.Exposures.of(views, 12.0, 0.02), is_test=np.zeros(2, dtype=bool), oversample=4)


def begun(scan: hs.Scan, monkeypatch, aside: float, typical: float, prior=KNOWN) -> tuple[Tensor, Tensor, Beginning]:
    """Centres of the cloud that is begun with, of the ordinary one, and what was said."""
    trained = Trained(Says(aside), Card(typical_misfit={"2": typical}))  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    told = list[Beginning]()
    task = Task(scan, prior, on_beginning=told.append)
    found = GaussianStage(OPTIONS).start(task, None)
    assert isinstance(found, GaussianCloud)
    assert len(told) == 1
    return found.centres, starting_cloud(task, replace(OPTIONS, start="phase")).centres, told[0]


def test_a_right_guess_is_begun_with(scan, monkeypatch):
    found, ordinary, told = begun(scan, monkeypatch, 0.0, 1.0)

    assert told.taken == "learned"
    assert "The run began with the network's guess: fitted for a while, it leaves " in told.why
    assert found.shape != ordinary.shape or not torch.equal(found, ordinary)
    assert told.guess is not None
    assert told.guess.of_copies  # there are two views
    assert told.guess.spread.shape == told.guess.volume.grid.shape


def test_a_guess_that_explains_less_changes_nothing(scan, monkeypatch):
    found, ordinary, told = begun(scan, monkeypatch, 1.5e-6, 1.0)

    assert told.taken == "phase"
    assert "fitted for a while, the network's guess leaves " in told.why
    assert torch.equal(found, ordinary)


def test_a_guess_that_frames_contradict_goes_on_with_phase_retrieval(scan, monkeypatch):
    found, ordinary, told = begun(scan, monkeypatch, 4e-6, 0.1)

    assert told.taken == "phase"
    assert told.why.startswith("The frames contradict the network's guess (it leaves ")
    assert told.why.endswith("at most 15 %): the run began with phase retrieval.")
    assert torch.equal(found, ordinary)


@pytest.mark.parametrize("after", [0.05, 0.19], ids=["better", "no better"])
def test_a_guess_that_seems_better_is_taken_if_it_still_is_after_a_whole_fit(scan, monkeypatch, after):
    frames = torch.from_numpy(scan.frames)
    near = torch.cat([frames[:1], frames[1:] + 0.1])
    left = iter([0.4, 0.1, 0.2, after])  # of phase retrieval and of the guess, in both rounds
    steps = []

    def of(task, cloud, evidence, how, fitted):
        steps.append(how)
        share = next(left)
        return _Trial(share, near if len(steps) % 2 else frames, closed=True)

    monkeypatch.setattr(_Trial, "of", of)
    _, _, told = begun(scan, monkeypatch, 0.0, 1.0)

    assert steps == [(4, 3), (4, 3), (6, 4), (6, 4)]
    assert told.taken == ("learned" if after == 0.05 else "phase")
    assert f"; fitted to the end, it leaves {100 * after:.2g} % of the frames unexplained, and phase" in told.why


def test_a_guess_that_is_better_by_no_more_than_noise_is_not_taken(scan, monkeypatch):
    contrast = float((torch.from_numpy(scan.frames) - 1).square().mean().sqrt())
    noise = NoiseModel.white_only(torch.full((2,), 0.2 * contrast), scan.views.shape)
    evidence = Evidence(MissingMatter(scan, MATERIAL), noise)
    frames, closer = torch.from_numpy(scan.frames), LearnedStart()
    plain, guess = _Trial(0.2, 1 + 0.99 * (frames - 1), closed=True), _Trial(0.1, frames, closed=True)
    far = replace(plain, predicted=1 + 0.1 * (frames - 1))

    assert not guess.clearly_better(plain, evidence, closer)
    assert guess.clearly_better(far, evidence, closer)
    assert not replace(guess, closed=False).clearly_better(far, evidence, closer)
    assert not replace(guess, left=0.19).clearly_better(far, evidence, closer)


def test_frames_that_validate_are_left_out_with_their_light(scan):
    three = hs.Scan(
        np.concatenate([scan.frames, scan.frames[:1]]), scan.exposures[np.array([0, 1, 0])], np.zeros(3, dtype=bool)
    )
    fit = replace(OPTIONS.fit, schedule=replace(OPTIONS.fit.schedule, validation_views=1))
    task = prepared(Task(three, KNOWN))
    seen = GaussianStage(replace(OPTIONS, fit=fit))._without_validation(task)

    assert len(seen.scan) == len(seen.noise) == 2
    assert GaussianStage(OPTIONS)._without_validation(task) is task


def test_a_network_of_one_material_is_not_asked_for_two(scan, monkeypatch):
    two = hs.MaterialPrior.known(MATERIAL, hs.DeltaBeta(4e-7, 8e-10))

    _, _, told = begun(scan, monkeypatch, 0.0, 1.0, two)

    assert told.why == ("The network guesses one material, and two are known: the run began with phase retrieval.")
    assert told.guess is None


def test_a_run_with_a_guess_that_is_not_taken_is_that_without(scan, monkeypatch):
    trained = Trained(Says(4e-6), Card(typical_misfit={"2": 0.1}))  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    fit = replace(OPTIONS.fit, schedule=replace(OPTIONS.fit.schedule, steps=3))
    runs = [replace(OPTIONS, start=start, fit=fit) for start in ("learned", "phase")]

    ours, plain = (solve_stages(run, Task(scan, KNOWN)) for run in runs)

    assert all(
        torch.equal(value, plain.state()[name]) for name, value in ours.state().items() if isinstance(value, Tensor)
    )


@pytest.mark.parametrize(("aside", "typical"), [(4e-6, 0.0), (4e-6, 1.0)], ids=["contradicted", "compared"])
@pytest.mark.parametrize("rows", [24, 12], ids=["small frames", "large frames"])
def test_surfaces_beside_a_guess_that_is_not_taken_are_those_without(monkeypatch, aside, typical, rows):
    trained = Trained(Says(aside), Card(typical_misfit={"6": typical}))  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    monkeypatch.setattr("holosplat.methods.coarse.FEWEST_ROWS", rows // 2)
    views = hs.Views.evenly_spaced(6, (36, 38), PIXEL)
    ball = hs.MeshScene.of_one_material([Ball(CENTRE / 2, 16 * PIXEL).mesh()], MATERIAL)
    scan = hs.simulate(ball, hs.Exposures.of(views, 12.0, 0.02), is_test=np.zeros(6, dtype=bool), oversample=4)
    short = replace(OPTIONS.fit, schedule=replace(OPTIONS.fit.schedule, steps=5))
    coarse = CoarseToFine(columns=18 if rows == 12 else 128, chord=2.0, coarse_steps=4, finer_steps=3, last_steps=3)
    told, found = list[Beginning](), dict[str, SurfaceMesh]()

    for start in ("phase", "learned"):
        gaussians = replace(OPTIONS, start=start, fit=short, coarse=coarse)
        made = solve_stages(Surfaces(gaussians=gaussians).with_effort(0.1), Task(scan, KNOWN, on_beginning=told.append))
        assert isinstance(made, SurfaceMesh)
        found[start] = made

    assert [each.taken for each in told] == ["phase"]
    assert torch.equal(found["learned"].vertices, found["phase"].vertices)
    assert torch.equal(found["learned"].faces, found["phase"].faces)
