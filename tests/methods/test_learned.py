"""A network's guess beside phase retrieval: what is begun with, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import holosplat as hs
from holosplat.baselines import HolographicTV
from holosplat.inference import Decision
from holosplat.learning.network import Taps
from holosplat.learning.start import Card, GuessedMatter, LearnedStart, Trained
from holosplat.methods import Gaussians, Surfaces, Task
from holosplat.methods.coarse import CoarseToFine
from holosplat.methods.gaussians import GaussianStage
from holosplat.methods.illumination import prepared
from holosplat.methods.learned import GUESS, PLAIN
from holosplat.methods.method import solve_stages
from holosplat.methods.start import starting_cloud
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
    learned=LearnedStart(trial_steps=6, trial_surfaces=4),
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


def begun(
    scan: hs.Scan, monkeypatch, aside: float, prior=KNOWN, options: Gaussians = OPTIONS
) -> tuple[Tensor, Tensor, Decision, GuessedMatter | None]:
    """Centres of the cloud that is begun with, of the ordinary one, the decision, and the guess."""
    trained = Trained(Says(aside), Card())  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    said = list[tuple[Decision, GuessedMatter | None]]()
    task = Task(scan, prior, on_start=lambda *each: said.append(each))
    found = GaussianStage(options).start(task, None)
    assert isinstance(found, GaussianCloud)
    assert len(said) == 1
    return found.centres, starting_cloud(task, replace(options, start="phase")).centres, *said[0]


def test_a_right_guess_is_begun_with(scan, monkeypatch):
    found, ordinary, decision, guess = begun(scan, monkeypatch, 0.0)

    assert decision.choice == GUESS
    assert [each.name for each in decision.compared] == [GUESS]
    assert decision.line.startswith("start: network's guess (data fission: network's guess +")
    assert found.shape != ordinary.shape or not torch.equal(found, ordinary)
    assert guess is not None
    assert guess.of_copies  # there are two views
    assert guess.spread.shape == guess.volume.grid.shape


@pytest.mark.parametrize("aside", [1.5e-6, 4e-6])
def test_a_guess_that_predicts_less_changes_nothing(scan, monkeypatch, aside):
    found, ordinary, decision, _ = begun(scan, monkeypatch, aside)

    assert decision.choice == PLAIN
    assert decision.compared[0].gain < 0
    assert torch.equal(found, ordinary)


def test_a_guess_is_not_taken_where_noise_hides_the_difference(scan, monkeypatch):
    """Starts that nothing is fitted from are compared; with noise as large as the contrast, nothing is sure."""
    contrast = float(np.sqrt(np.square(scan.frames - 1).mean()))
    noise = np.random.default_rng(3).normal(0, 4 * contrast, scan.frames.shape).astype(np.float32)
    noisy = replace(scan, frames=scan.frames + noise)

    found, ordinary, decision, _ = begun(noisy, monkeypatch, 0.0)

    assert decision.choice == PLAIN
    assert torch.equal(found, ordinary)


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

    _, _, decision, guess = begun(scan, monkeypatch, 0.0, two)

    assert decision.line == "start: phase retrieval (several materials are known, and the network guesses one)"
    assert guess is None


def test_a_run_with_a_guess_that_is_not_taken_is_that_without(scan, monkeypatch):
    trained = Trained(Says(4e-6), Card())  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    fit = replace(OPTIONS.fit, schedule=replace(OPTIONS.fit.schedule, steps=3))
    runs = [replace(OPTIONS, start=start, fit=fit) for start in ("learned", "phase")]

    ours, plain = (solve_stages(run, Task(scan, KNOWN)) for run in runs)

    assert all(
        torch.equal(value, plain.state()[name]) for name, value in ours.state().items() if isinstance(value, Tensor)
    )


@pytest.mark.parametrize("rows", [24, 12], ids=["small frames", "large frames"])
def test_surfaces_beside_a_guess_that_is_not_taken_are_those_without(monkeypatch, rows):
    trained = Trained(Says(4e-6), Card())  # type: ignore[arg-type]
    monkeypatch.setattr(LearnedStart, "network", property(lambda self: trained))
    monkeypatch.setattr("holosplat.methods.coarse.FEWEST_ROWS", rows // 2)
    views = hs.Views.evenly_spaced(6, (36, 38), PIXEL)
    ball = hs.MeshScene.of_one_material([Ball(CENTRE / 2, 16 * PIXEL).mesh()], MATERIAL)
    scan = hs.simulate(ball, hs.Exposures.of(views, 12.0, 0.02), is_test=np.zeros(6, dtype=bool), oversample=4)
    short = replace(OPTIONS.fit, schedule=replace(OPTIONS.fit.schedule, steps=5))
    coarse = CoarseToFine(columns=18 if rows == 12 else 128, chord=2.0, coarse_steps=4, finer_steps=3, last_steps=3)
    said, found = list[Decision](), dict[str, SurfaceMesh]()

    for start in ("phase", "learned"):
        gaussians = replace(OPTIONS, start=start, fit=short, coarse=coarse)
        task = Task(scan, KNOWN, on_start=lambda decision, guess: said.append(decision))
        made = solve_stages(Surfaces(gaussians=gaussians).with_effort(0.1), task)
        assert isinstance(made, SurfaceMesh)
        found[start] = made

    assert [each.choice for each in said] == [PLAIN]
    assert torch.equal(found["learned"].vertices, found["phase"].vertices)
    assert torch.equal(found["learned"].faces, found["phase"].faces)
