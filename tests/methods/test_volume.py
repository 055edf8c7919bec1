"""A smooth volume of continuous matter: better than its start, in noise and without, and the mass that frames know."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.soft import MATERIAL, PIXEL, cells, two_cells
from holosplat.baselines import HolographicTV
from holosplat.baselines.tomography import plateau
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.smooth_volume import ContinuousPrior, VolumeProblem, descend
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import HolographicVoxels, SmoothVolume, Task, smooth_fit, solve
from holosplat.methods.modulation import modulated, unshrunk
from holosplat.methods.smooth_fit import SmoothFit
from holosplat.methods.volume import SmoothStage, binning
from holosplat.optics.background import Light, LightOptions
from holosplat.optics.noise import NoiseModel
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.volume import Object
from holosplat_bench.specimens.soft_matter import round_cell, tissue

pytestmark = pytest.mark.usefixtures("plain_light")

RATIO = MaterialPrior.of_ratio(1500.0)
QUICK = HolographicTV(retrieval=10, iterations=20, corrections=0, upper=0.0)
SHORT = SmoothVolume(iterations=10)
"""Half of the iterations by default."""


@pytest.fixture(scope="module")
def quiet() -> Scan:
    """Eight views without noise."""
    return two_cells()


def noisy(scan: Scan, sigma: float, seed: int) -> Scan:
    """The scan with photon noise of relative standard deviation `sigma`."""
    counts = np.random.default_rng(seed).poisson(scan.frames / sigma**2)
    return replace(scan, frames=(counts * sigma**2).astype(np.float32))


def judged(found, scan: Scan) -> tuple[float, float]:
    """Relative error of δ, and the total over the true one."""
    grid = Grid.of_views(scan.views)
    true, delta = (np.asarray(o.voxelise(grid).delta, dtype=np.float64) for o in (cells(), found))
    return float(np.linalg.norm(delta - true) / np.linalg.norm(true)), float(delta.sum() / true.sum())


def test_it_is_better_than_the_start_without_noise(quiet):
    task = Task(quiet, RATIO)
    error, total = judged(solve(SHORT, task), quiet)
    start, _ = judged(solve(HolographicVoxels(), task), quiet)
    assert error < min(0.05, start)
    assert total == pytest.approx(1.0, abs=0.05)


def test_noise_of_half_the_contrast_keeps_the_mass(quiet):
    """Of eight small views, to 15 %."""
    contrast = float(np.sqrt(np.square(quiet.frames - 1).mean()))
    scan = noisy(quiet, 0.5 * contrast, 1)
    error, total = judged(solve(SmoothVolume(), Task(scan, RATIO), "continuous"), scan)
    start, _ = judged(solve(HolographicVoxels(), Task(scan, RATIO)), scan)
    assert error < min(0.15, 1.1 * start)
    assert total == pytest.approx(1.0, abs=0.15)


def test_noise_wipes_nothing_out():
    """Neither the start nor the fit loses the mass of a round cell in noise of three quarters of its contrast."""
    exposures = Exposures.of(Views.evenly_spaced(8, (28, 31), PIXEL), 20.0, 0.05)
    cell = round_cell(30e-6, MATERIAL, seed=2)
    scan = simulate(cell, exposures, is_test=np.zeros(8, dtype=bool))
    scan = noisy(scan, 0.75 * float(np.sqrt(np.square(scan.frames - 1).mean())), 3)
    start = SmoothStage(SmoothVolume()).start(Task(scan, RATIO), None)
    grid, totals = Grid.of_views(scan.views), []
    true = float(np.asarray(cell.voxelise(grid).delta, dtype=np.float64).sum())
    for found in (start, solve(SHORT, Task(scan, RATIO), "continuous")):
        totals.append(float(np.asarray(found.voxelise(grid).delta, dtype=np.float64).sum()) / true)
    assert totals == pytest.approx([1.0, 1.0], abs=0.25)


def test_the_last_round_goes_on_while_it_finds_matter(quiet, monkeypatch):
    """From a hundredth of it, by an iteration a round; not where that is no growth; and after it was stopped, too."""
    task = Task(quiet, RATIO)
    stage = SmoothStage(SmoothVolume(QUICK, coarser=(), rounds=1, iterations=1))
    start = stage.start(task, None)
    faint = start.with_parameters({"values": 0.01 * start.values})
    more = []
    for growing in (smooth_fit.GROWING, math.inf):
        monkeypatch.setattr(smooth_fit, "GROWING", growing)
        monkeypatch.setattr(smooth_fit, "EXPLAINED", math.inf)
        monkeypatch.setattr(smooth_fit, "WEAKER", math.inf)
        fit = stage.fit(task, faint)
        fit.run(lambda record: None)
        more.append(fit.step)
        again, rest = stage.fit(task, faint), stage.fit(task, faint)
        again.run(lambda record: None, until=1)
        rest.load(again.state_dict())
        rest.run(lambda record: None)
        assert (rest.step, rest._more) == (fit.step, fit._more)
        assert torch.equal(rest.voxels.values, fit.voxels.values)
    assert 1 + smooth_fit.MOST >= more[0] > more[1] == 1


def test_a_round_goes_on_while_it_explains_more(quiet, monkeypatch):
    """Where frames are not explained yet; and after it was stopped, too."""
    task = Task(quiet, RATIO)
    stage = SmoothStage(SmoothVolume(QUICK, coarser=(), rounds=1, iterations=12))
    start = stage.start(task, None)
    monkeypatch.setattr(smooth_fit, "WEAKER", math.inf)
    monkeypatch.setattr(smooth_fit, "GROWING", math.inf)
    fits = [stage.fit(task, start) for _ in range(4)]
    fits[0].run(lambda record: None)
    fits[1].run(lambda record: None, until=15)
    fits[2].load(fits[1].state_dict())
    fits[2].run(lambda record: None)
    monkeypatch.setattr(smooth_fit, "EXPLAINED", math.inf)
    fits[3].run(lambda record: None)
    assert fits[3].step == 12
    assert 12 < fits[0].step <= 12 * smooth_fit.LONGEST
    assert fits[2].step == fits[0].step
    assert torch.equal(fits[2].voxels.values, fits[0].voxels.values)


def test_a_fit_that_begins_again_from_nothing_may_be_weakened_again(quiet):
    """Though a stronger prior had settled before."""
    task = Task(quiet, RATIO)
    stage = SmoothStage(SmoothVolume(QUICK))
    fit = stage.fit(task, stage.start(task, None))
    empty = fit.voxels.with_parameters({"values": torch.zeros_like(fit.voxels.values)})
    problem = VolumeProblem(fit._frames_of(1), fit.plan.prior, 1.0)
    fit._settled = True
    assert fit._weakened(empty, 2 * smooth_fit.EMPTY, problem)
    assert not fit._settled


def test_half_a_prior_that_was_refused_is_not_tried_again(quiet):
    """Where the last round leaves nothing, what the stronger prior found stands; of a fit that was stopped, too. A
    foam was fitted for ever, with this prior and half of it in turns."""
    stage = SmoothStage(SmoothVolume(QUICK))
    start = stage.start(Task(quiet, RATIO), None)
    fit, again = (stage.fit(Task(quiet, RATIO), start) for _ in range(2))
    found, last = fit.voxels, len(fit.plan.legs()) - 1
    more, empty = (found.with_parameters({"values": share * found.values}) for share in (2, 0))
    problem = VolumeProblem(fit._frames_of(1), fit.plan.prior, 1.0)
    fit._leg = last - 1
    assert fit._weakened(found, 1.2, problem)
    fit._leg = last - 1
    assert not fit._weakened(more, 1.8, problem)
    again.load(fit.state_dict())
    for one in (fit, again):
        one._leg = last
        assert not one._weakened(empty, 2 * smooth_fit.EMPTY, problem)
        assert torch.equal(one.voxels.values, found.values)
        assert one.resolved()["prior_share"] == 1


def test_next_to_nothing_is_nothing(quiet):
    """Or the prior, in units of its level, had no lower bound."""
    fit = SmoothStage(SmoothVolume()).fit(
        Task(quiet, RATIO), SmoothStage(SmoothVolume(QUICK)).start(Task(quiet, RATIO), None)
    )
    u = fit.plan.begun.values[0]
    assert torch.equal(fit._or_nothing(0.01 * u), 0.01 * u)
    assert not fit._or_nothing(1e-5 * u).any()
    assert not fit._or_nothing(0 * u).any()


def tissue_in_noise(noise: float, moved: int = 0) -> tuple[Scan, float]:
    """Eight views of tissue, moved by up to so many pixels, in noise of that share of their contrast; ∫ δ [m³]."""
    views = Views.evenly_spaced(8, (25, 28), PIXEL)
    h, w = (n * PIXEL for n in views.shape)
    truth = tissue((0.85 * w, 0.85 * h, 0.85 * w), DeltaBeta(1.2e-7, 8e-11), seed=3)
    scan = simulate(truth, Exposures.of(views, 20.0, 0.1), is_test=np.zeros(8, dtype=bool))
    steps = np.random.default_rng(2).integers(-moved, moved + 1, (8, 2))
    frames = np.stack([np.roll(frame, step, (0, 1)) for frame, step in zip(scan.frames, steps)])
    scan = replace(scan, frames=frames)
    return noisy(scan, noise * float(np.sqrt(np.square(scan.frames - 1).mean())), 1), total_of(truth, scan)


def total_of(found: Object, scan: Scan) -> float:
    """∫ δ dV [m³]."""
    return float(np.asarray(found.voxelise(Grid.of_views(scan.views)).delta, dtype=np.float64).sum()) * PIXEL**3


class Begun:
    """Fits of a smooth volume to the same frames; they begin with one start."""

    def __init__(self, scan: Scan) -> None:
        self.stage, self.task = SmoothStage(SmoothVolume()), Task(scan, RATIO, matter="continuous")
        self.start = self.stage.start(self.task, None)

    def fit(self) -> SmoothFit:
        """A fit that has not run."""
        return self.stage.fit(self.task, self.start)

    def fitted(self) -> SmoothFit:
        """One at its end."""
        fit = self.fit()
        fit.run(lambda record: None)
        return fit


def test_a_prior_that_hides_matter_is_weakened_and_a_stopped_fit_goes_on_with_it():
    """Tissue fills the field in noise of its contrast: half of the prior, at most, keeps its mass."""
    scan, true = tissue_in_noise(1.0)
    begun = Begun(scan)
    whole, second, states = begun.fit(), begun.fit(), dict[int, dict]()
    while not whole.finished:
        whole.run(lambda record: None, until=whole.step + 2)
        states[whole.step] = whole.state_dict()
    assert whole.resolved()["prior_share"] <= 0.5
    assert total_of(whole.voxels, scan) == pytest.approx(true, rel=0.1)
    second.load(states[sorted(states)[-2]])
    assert 0 < whole.step - second.step <= 2
    second.run(lambda record: None)
    assert torch.equal(second.voxels.values, whole.voxels.values)
    assert second.resolved() == whole.resolved()


def test_a_prior_stays_where_a_weaker_one_explains_no_more():
    """Of frames that are not where they say: the fit begins again on its largest voxels once, and takes that back."""
    scan, _ = tissue_in_noise(0.1, moved=3)
    found, edges = Begun(scan).fit(), list[float]()
    found.run(lambda record: edges.append(record["voxel_px"]))
    assert found.resolved()["prior_share"] == 1
    assert sum(after > before for before, after in pairwise(edges)) == 1


def test_noise_alone_is_no_matter():
    frames = np.random.default_rng(5).normal(1.0, 0.05, (8, 25, 28)).astype(np.float32)
    scan = Scan(frames, Exposures.of(Views.evenly_spaced(8, (25, 28), PIXEL), 20.0, 0.1), np.zeros(8, dtype=bool))
    fit = Begun(scan).fitted()
    assert fit.resolved()["prior_share"] == 1
    assert not fit.voxels.values.any()


def plainly(scan: Scan, options: SmoothVolume) -> torch.Tensor:
    """The volume without a fit that can be stopped: one descent after another."""
    task = Task(scan, RATIO)
    first = SmoothStage(options).start(task, None)
    start = first.values[0]

    def frames(factor: int) -> WhitenedFrames:
        return WhitenedFrames(scan.binned(factor), first.matter.channels[0], task.noise.binned(factor))

    def rounds(seen: WhitenedFrames, prior: ContinuousPrior, u: torch.Tensor, loose: float = 0.0) -> torch.Tensor:
        factors = [loose] * (loose > 0) + [1.0] * options.rounds
        for i, factor in enumerate(factors):
            problem = VolumeProblem(seen, prior, factor * plateau(u))
            mended = modulated if loose or i < len(factors) - 1 else unshrunk
            u = mended(problem, descend(problem, u, options.iterations)[0])
        return u

    grid = Grid.of_views(scan.binned(2).views)
    coarse = first.resampled(grid).values[0]
    even = torch.full_like(coarse, options.faint * plateau(coarse)) if options.faint else coarse
    coarse = rounds(frames(2), options.prior.on_larger_voxels(2), even, options.loose)
    seen = frames(1)
    u = VoxelGrid(coarse[None], grid, first.matter).resampled(first.grid).values[0]
    problem, half = VolumeProblem(seen, options.prior, plateau(u)), options.iterations // 2
    found, values = descend(problem, u, half)
    if 2 * seen(problem.lines(found)).value > seen.count:
        other, others = descend(problem, start, half)
        clearly = smooth_fit.CLEARLY if options.faint else 1.0
        found = other if clearly * others[-1] < values[-1] else found
    return rounds(seen, options.prior, found)


@pytest.mark.parametrize(("sigma", "faint"), [(0.0, 1.0), (0.02, 1.0), (0.02, 0.0)])  # fainter matter is lost so soon
def test_a_fit_in_steps_is_one_descent_after_another(quiet, sigma, faint, monkeypatch):
    """Bit for bit, and so is one that goes on from a saved state, wherever it was stopped."""
    monkeypatch.setattr(smooth_fit, "EXPLAINED", math.inf)  # so short a fit explains nothing
    monkeypatch.setattr(smooth_fit, "WEAKER", math.inf)
    monkeypatch.setattr(smooth_fit, "GROWING", math.inf)  # and would go on
    few = quiet[[0, 2, 4, 6]]
    scan = noisy(few, sigma, 1) if sigma else few
    options = SmoothVolume(QUICK, coarser=(2,), faint=faint, rounds=2, iterations=2)
    wanted = plainly(scan, options)
    task = Task(scan, RATIO)
    start = SmoothStage(options).start(task, None)
    whole = SmoothStage(options).fit(task, start)
    records: list[dict[str, float]] = []
    whole.run(records.append)
    assert torch.equal(whole.voxels.values[0], wanted)
    assert [record["step"] for record in records] == list(range(1, whole.step + 1))
    assert whole.finished
    assert whole.share == pytest.approx(1.0)
    for stop in (1, whole.step // 2, whole.step - 1):
        first = SmoothStage(options).fit(task, start)
        first.run(lambda record: None, until=stop)
        assert not first.finished
        second = SmoothStage(options).fit(task, start)
        second.load(first.state_dict())
        assert second.step == stop
        second.run(lambda record: None)
        assert torch.equal(second.voxels.values[0], wanted), stop


def test_an_interrupted_fit_gives_what_it_has_reached(quiet):
    """On voxels of a pixel, better than the start."""
    task = Task(noisy(quiet, 0.02, 1), RATIO)
    start = SmoothStage(SmoothVolume()).start(task, None)
    fit = SmoothStage(SmoothVolume()).fit(task, start)
    fit.run(lambda record: None, until=130)
    assert 0 < fit.share < 1
    assert fit.voxels.grid == start.grid
    assert judged(fit.voxels, quiet)[0] < judged(start, quiet)[0]


def test_large_frames_are_binned(quiet):
    assert binning(quiet, 10**9) == 1
    assert quiet.binned(binning(quiet, 10_000)).views.shape == (15, 17)


def test_effort_is_a_share_of_the_iterations():
    assert SmoothVolume().with_effort(0.5).iterations == SmoothVolume().iterations // 2
    with pytest.raises(InputError, match="coarser must be"):
        SmoothVolume(coarser=(2, 4))
    with pytest.raises(InputError, match="rounds must"):
        SmoothVolume(rounds=-1)


def test_noise_of_binned_frames_is_that_of_their_means():
    """White noise and grain of two pixels: the spectra agree with those of binned noise."""
    generator = torch.Generator().manual_seed(5)
    white = torch.randn(400, 24, 30, generator=generator, dtype=torch.float64)
    fy, fx = torch.fft.fftfreq(24).double()[:, None], torch.fft.rfftfreq(30).double()
    shape = torch.exp(-80 * (fy**2 + fx**2))
    grain = torch.fft.irfft2(
        torch.fft.rfft2(torch.randn(400, 24, 30, generator=generator).double()) * shape, s=(24, 30)
    )
    frames = 0.3 * white + grain
    noise = NoiseModel(torch.full((1,), 0.3, dtype=torch.float64), (shape**2)[None], 30)
    binned = frames.reshape(400, 12, 2, 15, 2).mean(dim=(2, 4))
    power = torch.fft.rfft2(binned, norm="ortho").abs().square().mean(dim=0)
    found = noise.binned(2)
    assert found.shape == (12, 15)
    low = (slice(0, 3), slice(0, 3))
    np.testing.assert_allclose(found.power()[0][low].numpy(), power[low].numpy(), rtol=0.3)
    assert float(found.power().mean()) == pytest.approx(float(power.mean()), rel=0.15)


@pytest.mark.parametrize(("known", "uneven"), [(True, False), (True, True), (False, False)])
def test_the_last_round_goes_by_the_frequencies_that_know_the_total(quiet, monkeypatch, known, uneven):
    """Once, and told of the light; where δ/β was estimated, by all frequencies as before."""
    seen = list[bool]()
    monkeypatch.setattr(smooth_fit, "unshrunk", lambda problem, u, light: seen.append(light) or u)
    monkeypatch.setattr(smooth_fit, "EXPLAINED", math.inf)
    monkeypatch.setattr(smooth_fit, "WEAKER", math.inf)
    options = SmoothVolume(QUICK, coarser=(2,), rounds=2, iterations=1)
    task = Task(quiet[[0, 2, 4, 6]], RATIO)
    fit = SmoothStage(options).fit(task, SmoothStage(options).start(task, None))
    light = Light.of(torch.from_numpy(quiet.frames), LightOptions("even")) if uneven else None
    fit.plan = replace(fit.plan, ratio_known=known, light=light)
    fit.run(lambda record: None)
    assert seen == ([uneven] if known else [])


def test_matter_beyond_the_frames_is_noise_in_uneven_light_too(quiet):
    """A tenth of the contrast at least, of the frames' own noise and of that with the doubt of their light."""
    frames = torch.from_numpy(quiet.frames)
    task = replace(Task(quiet, RATIO), lit=Light.of(frames, LightOptions("smooth")))
    taller = Grid.of_views(quiet.views.taller(4))
    begun = VoxelGrid(torch.ones(1, *taller.shape), taller, Matter.one(*MATERIAL))
    fit = SmoothStage(SmoothVolume()).fit(task, begun)
    assert fit.plan.light is not None
    assert fit.plan.frames(1)._apart is not None  # what is not known of the light is an unknown of the fit
    least = 0.09 * float(frames.sub(1).double().square().mean().sqrt())
    assert float(fit.plan.light.noise.white.min()) > least
    assert float(fit.plan.noise.white.min()) > least
