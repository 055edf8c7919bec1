"""The benchmarks' opponents compute the same as we do, and their scripts' parts work; speed is not asserted."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from holosplat.experiments.settings import preset
from holosplat.projectors.splat import splat

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """The modules of benchmarks/, which import one another by bare names."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return {
        name: importlib.import_module(name)
        for name in (
            *("step", "eager_step", "kernels", "plain_torch", "ablation", "simulate"),
            *("tweezers", "espresso_flow", "tune_fields"),
        )
    }


@pytest.mark.parametrize("add", ["index_add_", "scatter_add_"])
def test_the_plain_splat_is_the_splat(scripts, add):
    work = scripts["kernels"].Workload(3, 40, 60, (1.0, 3.0), 4.0)
    arrays, (rotations, shifts) = work.cloud(), work.poses()
    weights = torch.randn(3, 2, 40, 40, generator=torch.Generator().manual_seed(3))
    results = []
    for draw in (
        lambda *a: scripts["plain_torch"].splat(*a, rotations.float(), (40, 40), 4.0, 1 / 12, add),
        lambda *a: splat(*a, rotations, shifts, (40, 40)),
    ):
        leaves = [a.clone().requires_grad_() for a in arrays]
        image = draw(*leaves)
        results.append([image.detach(), *torch.autograd.grad(image, leaves, weights)])
    for found, wanted in zip(*results):  # boxes found in float32 may differ by a faint row of pixels
        assert float((found - wanted).abs().max() / wanted.abs().max()) < 5e-3


def test_the_eager_step_is_our_step(scripts):
    """The same loss before the first step, up to matter beyond the frame, and a falling one after some."""
    step = scripts["step"]
    scan, cloud = step.workload(200, 48)
    inside = cloud.replaced((cloud.centres * 0.5, *cloud.parameters[1:]))
    eager, fit = scripts["eager_step"].EagerStep(scan, inside, step.RATES), step.fit_of(scan, inside, "cpu")
    losses = [eager.step() for _ in range(3)]
    times, last = step.steps(fit, 1)
    assert len(times) == 1
    assert losses[0] == pytest.approx(last, rel=2e-2)
    assert losses[2] < losses[0]
    assert step.steps(fit, 2)[1] < last


def test_what_a_step_and_its_parts_report(scripts, monkeypatch):
    step = scripts["step"]
    monkeypatch.setattr(step, "SIZES", {"tiny": (50, 32)})
    assert step.compare("tiny", 1).keys() >= {"step_ms_tiny", "eager_ms_tiny", "step_ratio_tiny"}
    assert {"part_ms_tiny_splat", "part_ms_tiny_adam"} <= step.parts("tiny", 1).keys()


def test_what_the_kernels_report(scripts):
    kernels = scripts["kernels"]
    work = kernels.Workload(2, 32, 40, (1.0, 2.0), 3.0)
    assert kernels.splat_pairs(work) > 40
    seconds = kernels.minima({"ours": kernels.calls(work), "torch": kernels.torch_calls(work, "index_add_")}, 1)
    assert all(0 < value < 60 for pair in seconds.values() for value in pair)


def test_every_ablation_removes_something(scripts):
    settings = preset("default")
    variants = {name: change(settings) for name, change in scripts["ablation"].VARIANTS.items()}
    assert variants.pop("as it is") == settings
    assert settings not in variants.values()
    assert len({repr(variant) for variant in variants.values()}) == len(variants)


def test_the_table_of_the_tweezers(scripts):
    """Values outside the bounds are bold and not counted; means of what was measured lie within."""
    tweezers = scripts["tweezers"]
    found = [
        tweezers.Stretched(1e-12 * pn, 1e-6 * axial[0], 1e-6 * transverse[0], 0.001, -0.002, 0.0, torch.zeros(1, 3))
        for pn, axial, transverse in zip(tweezers.FORCES_PN, tweezers.AXIAL, tweezers.TRANSVERSE)
    ]
    assert tweezers.within(found) == (10, 10)
    assert "**" not in "".join(tweezers.table(found))
    found[3] = replace(found[3], axial=11.8e-6)
    found[4] = replace(found[4], transverse=5.3e-6)
    assert tweezers.within(found) == (9, 9)
    lines = tweezers.table(found)
    assert len(lines) == 12
    assert "| 68 | **11.80** | 12.87 (11.88–13.87) | 4.64 |" in lines[5]
    assert "| **5.30** |" in lines[6]


def test_espressos_cells_go_on_as_espresso_has_them(scripts, espresso_rbc):
    """Two cells, from one snapshot to the next: they move by a micrometre, and their nodes end 0.05 µm from ours."""
    flow = scripts["espresso_flow"]
    run = flow.Run.read(espresso_rbc, most=2)
    run = replace(run, nodes=run.nodes[:, :2])
    nodes, _ = flow.ours(run, run.suspension(None))
    assert abs(nodes[1] - nodes[0]).max() > 0.5e-6
    assert np.linalg.norm(nodes[1] - run.nodes[1], axis=-1).mean() < 0.05e-6
    found = flow.statistics(run.nodes, run.suspension(None).membrane, run.times)
    assert 0.03 < found["drift"].min() < found["drift"].max() < 0.06
    assert abs(found["volume"]).max() < 0.01


def test_what_the_benchmark_of_simulation_reports(scripts, monkeypatch):
    """On a small field: frames by time and view, the volume, and an error well within what the docs promise."""
    script = scripts["simulate"]
    monkeypatch.setattr(script, "CELLS", 2)
    monkeypatch.setattr(script, "CASES", {"frames": (48, 2, 3, 1e-6), "voxels": (48, 1, 0, 1e-6)})
    rows = [script.run(name) for name in script.CASES]
    assert [row["frames"] for row in rows] == [6, 0]
    assert all(row["seconds"] > 0 for row in rows)
    monkeypatch.setattr(script, "SMALL", (33, 28))
    monkeypatch.setattr(script, "FINER", 8)
    errors = script.accuracy(1e-6)
    assert 0 < errors["single_precision"] < 1e-5
    assert 1e-4 < errors["method"] < 5e-3
    report = {"rows": rows, "accuracy": [errors], "load": 0.5, "commit": "abc", **script.environment("reference")}
    assert "| frames | 48² of 1 µm | 6 | 4 |" in script.table(report)
    assert "| voxels | 48³ of 1 µm | – | – |" in script.table(report)


def test_options_of_fields_are_varied_one_by_one(scripts):
    tune = scripts["tune_fields"]
    for options, table in ((tune.VoxelFit(), tune.VOXELS), (tune.NeuralFit(), tune.NEURAL)):
        found = tune.variants(options, table)
        assert found[0] == ("as it is", options)
        assert len({label for label, _ in found}) == len(found) == 1 + sum(map(len, table.values()))
        for _, other in found[1:]:  # a variant that is the default would be wasted
            assert sum(a != b for a, b in zip(vars(options).values(), vars(other).values())) == 1


def test_the_table_of_fields_compares_with_the_defaults(scripts):
    numbers = {"dice": 0.9, "ssim": 0.8, "frcm": 0.7}
    rows = [
        {"case": case, "seed": 1, "method": "voxels", "variant": label, "relative_error_delta": error, **numbers}
        for case, label, error in (("a", "as it is", 0.2), ("b", "as it is", 0.1), ("a", "x", 0.1), ("b", "x", 0.2))
    ]
    assert scripts["tune_fields"].table(rows, "voxels")[-1] == "| x | 0.150 | ×0.50, ×2.00 | 0.900 | 0.800 / 0.700 |"
