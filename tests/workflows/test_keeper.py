"""A run never ends worse than it began: the best of its states is kept, and said, also after a resume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.runs import KNOWN, SMALL
from helpers.soft import two_cells
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.inference import Compared, Decision
from holosplat.io.atomic import read_json
from holosplat.matter import MaterialPrior
from holosplat.methods import GaussianRates, SmoothVolume, solve
from holosplat.methods.gaussians import GaussianStage
from holosplat.methods.keeper import Keeper
from holosplat.methods.method import Task
from holosplat.representations import GaussianCloud, VoxelGrid
from holosplat.workflows.choice import Choice
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")

RUINOUS = replace(SMALL, fit=replace(SMALL.fit, rates=GaussianRates(raw_amplitudes=3.0)))
"""A fit that makes everything worse."""


def test_a_fit_that_goes_astray_ends_with_its_start(scan, tmp_path):
    folder = RunFolder(tmp_path / "run")
    done = reconstruct(scan, KNOWN, RUINOUS, matter="levels", folder=folder)
    assert done.choice.kept == "start"
    assert done.choice.judged["start"] < done.choice.judged["fit"]
    summary = read_json(folder.summary)
    assert summary["kept"] == "start"
    assert summary["decided"] == {"matter": "levels"}
    loaded = load_reconstruction(folder)
    assert loaded.choice == done.choice
    assert np.array_equal(loaded.object.parameters()["centres"], done.object.parameters()["centres"])
    assert done.choice.decisions[-1].name == "result"
    assert done.choice.lines()[-1].startswith("result: start (training frames: start +")


def test_stages_in_memory_keep_the_best_state_too(scan):
    task = Task(scan.train(), KNOWN)
    found = solve(RUINOUS, task, "levels")
    done = reconstruct(scan, KNOWN, RUINOUS, matter="levels")
    kept = done.object
    assert isinstance(found, GaussianCloud)
    assert isinstance(kept, GaussianCloud)
    assert torch.equal(found.centres, kept.centres)
    assert torch.equal(found.raw_amplitudes, kept.raw_amplitudes)


def test_a_fit_that_does_well_is_kept(scan):
    done = reconstruct(scan, KNOWN, SMALL, matter="levels")
    assert done.choice.kept == "fit"
    assert done.choice.judged["fit"] < done.choice.judged["start"]


def test_what_was_kept_survives_a_resume(scan, tmp_path):
    folder, whole = RunFolder(tmp_path / "run"), reconstruct(scan, KNOWN, RUINOUS, matter="levels")

    def interrupt(stage, fraction, record):
        if record.get("step") == 2:
            raise KeyboardInterrupt

    first = reconstruct(scan, KNOWN, RUINOUS, matter="levels", folder=folder, on_progress=interrupt)
    assert not first.finished
    assert first.choice.kept == ""
    done = reconstruct(scan, KNOWN, RUINOUS, matter="levels", folder=folder, resume=True)
    assert done.choice == whole.choice


def test_a_run_keeps_the_last_decision_of_each_name(scan, monkeypatch):
    """Where a stage starts may be decided in steps, the last of which is what holds."""
    own = GaussianStage.own_start

    def start(stage: GaussianStage, task: Task):
        for name, choice in (("bodies", "some"), ("surfaces", "these"), ("bodies", "none")):
            task.on_start(Decision(name, choice, "a test"), None)
        return own(stage, task)

    monkeypatch.setattr(GaussianStage, "own_start", start)
    done = reconstruct(scan, KNOWN, SMALL, matter="levels")
    told = [(each.name, each.choice) for each in done.choice.decisions if each.by == "a test"]
    assert told == [("surfaces", "these"), ("bodies", "none")]


def test_a_slightly_worse_share_may_be_noise(scan):
    train = scan.train()
    found = solve(SMALL, Task(train, KNOWN), "levels")
    keeper = Keeper(train)
    keeper.look("start", found, 2)
    keeper.look("fit", found, 2)
    assert keeper.best is not None
    assert keeper.best.name == "fit"


def test_steps_of_a_method_and_other_kinds_are_no_rivals(scan):
    """A worse state takes the place of a better one where it was not fitted, or is of the kind that was asked for; one
    that has lost the matter does not."""
    train = scan.train()
    good = solve(SMALL, Task(train, KNOWN), "levels")
    assert isinstance(good, GaussianCloud)
    bad, worse = (good.with_parameters({"raw_amplitudes": good.parameters()["raw_amplitudes"] - s}) for s in (0.7, 3))
    voxels = VoxelGrid(0 * bad.density(Grid.of_views(train.views))[None, 0], Grid.of_views(train.views), good.matter)
    for mixed, found, fitted, kept in (
        (False, bad, True, "first"),
        (False, bad, False, "second"),
        (False, worse, False, "first"),
        (False, voxels, True, "second"),
        (True, voxels, True, "first"),
    ):
        keeper = Keeper(train, mixed)
        keeper.look("first", good, 2)
        keeper.look("second", found, 2, fitted)
        assert keeper.best is not None
        assert keeper.best.name == kept
        assert keeper.judged["second"] > keeper.judged["first"]


def test_another_kind_must_also_predict_unseen_frames_better(scan):
    train = scan.train()
    good = solve(SMALL, Task(train, KNOWN), "levels")
    assert isinstance(good, GaussianCloud)
    grid = Grid.of_views(train.views)
    voxels, asked = VoxelGrid(0 * good.density(grid)[None, 0], grid, good.matter), list[tuple[str, str]]()
    for choice, gain, kept in (("voxels", -0.3, "second"), ("gaussians", 0.3, "first")):

        def unseen(null, other, found=choice, gained=gain):
            asked.append((null, other))
            return Decision("result", found, "views set aside", (Compared(other, gained, 0.01),))

        keeper = Keeper(train, True, unseen)
        keeper.look("first", good, 2)
        keeper.look("second", voxels, 2)
        assert keeper.best is not None
        assert keeper.best.name == kept
        assert keeper.decisions[0].line.endswith(
            f"(training frames; between kinds views set aside: first {gain:+.1%} ± 1.0%)"
        )
    assert asked == [("voxels", "gaussians")] * 2
    keeper = Keeper(train, True, lambda null, other: None)
    keeper.look("first", good, 2)
    keeper.look("second", voxels, 2)
    assert keeper.best is not None
    assert keeper.best.name == "first"
    assert keeper.decisions[0].by == "training frames"


def test_old_summaries_say_nothing():
    assert Choice.read({}) == Choice()
    assert Choice().lines() == []
    step = Choice(judged={"start": 0.13, "fit": 0.2, "smooth volume": 0.29}, kept="smooth volume")
    assert step.lines() == ["result: smooth volume"]
    assert Choice(kept="fit").lines() == []


@pytest.mark.parametrize("other", ["continuous", None], ids=["told", "found"])
def test_a_resume_needs_the_same_kind_of_matter(scan, tmp_path, other):
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan, KNOWN, SMALL, matter="levels", folder=folder)
    with pytest.raises(InputError, match="kind of matter"):
        reconstruct(scan, KNOWN, SMALL, matter=other, folder=folder, resume=True)


def test_a_smooth_volume_is_not_given_up_for_a_start_that_fits_the_noise():
    """The start explains noisy training frames better, and is nevertheless further from the truth."""
    scan = two_cells()
    frames = np.random.default_rng(1).normal(scan.frames, 0.5 * float(np.std(scan.frames)))
    noisy = replace(scan, frames=frames.astype(np.float32))
    found = reconstruct(noisy, MaterialPrior.of_ratio(1500.0), SmoothVolume(iterations=4), matter="continuous")
    assert found.choice.kept == "smooth volume"
