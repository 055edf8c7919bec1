"""The benchmarks' opponents compute the same as we do, and their scripts' parts work; speed is not asserted."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.methods import FitOptions, GaussianRates
from holosplat.methods.presets import preset
from holosplat.model import measure
from holosplat.projectors.splat import splat
from holosplat.specimens.membrane.model import Membrane
from holosplat.specimens.membrane.rest import resting_cell

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """The modules of benchmarks/, which import one another by bare names."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return {path.stem: importlib.import_module(path.stem) for path in BENCHMARKS.glob("*.py")}


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
    inside = cloud.with_parameters({"centres": cloud.centres * 0.5})
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
    seconds |= kernels.minima({"poses": kernels.calls(work, of_poses=True)}, 1)
    assert all(0 < value < 60 for pair in seconds.values() for value in pair)


def test_every_ablation_removes_something(scripts):
    settings = preset("default")
    variants = {name: change(settings) for name, change in scripts["ablation"].VARIANTS.items()}
    assert variants.pop("as it is") == settings
    assert settings not in variants.values()
    assert len({repr(variant) for variant in variants.values()}) == len(variants)


def test_the_summary_of_an_ablation_compares_with_the_whole_of_each_case(scripts):
    def row(case, photons, variant, error, frcm):
        values = {"photons": photons, "relative_error_delta": error, "frcm": frcm}
        return {"case": case, "seed": 101.0, "variant": variant, **values}

    rows = [
        row("a", 0.0, "as it is", 0.1, 0.9),
        row("a", 0.0, "less", 0.2, 0.8),
        row("b", 500.0, "as it is", 0.2, 0.7),
        row("b", 500.0, "less", 0.1, 0.75),
        row("c", 0.0, "less", 0.5, 0.1),  # nothing to compare it with
        row("b", 500.0, "worse", 1.0, 0.2),
    ]
    assert scripts["ablation"].summary(rows)[2:] == [
        "| worse | 1 | – | – | ×5.00 | -0.500 | `b`, ×5.00 |",
        "| less | 2 | ×2.00 | -0.100 | ×0.50 | +0.050 | `a`, ×2.00 |",
    ]


def test_rows_of_an_ablation_are_read_as_they_were_written(scripts, tmp_path):
    rows = [{"case": "a", "seed": 101.0, "variant": "as it is", "commit": "0e5", "photons": 0.0, "frcm": 0.25}]
    scripts["ablation"].write(rows, tmp_path / "rows.csv")
    assert scripts["ablation"].read(tmp_path / "rows.csv") == rows
    assert scripts["ablation"].read(tmp_path / "none.csv") == []


def test_every_trial_lowers_the_misfit_in_a_way_of_its_own(scripts):
    """No two of them, and none but the first, are the fit as it is."""
    scan, cloud = scripts["step"].workload(60, 40)
    found = {}
    for name, make in scripts["trials"].TRIALS.items():
        schedule, rates = Schedule(steps=100, validate_every=10), GaussianRates(0.05, 0.03, 0.01, 0.05)
        fit = make(scan, cloud, FitOptions(Objective(), schedule, rates))
        fit.run(lambda record: None)
        oversample = fit.model.instrument.oversample
        before, after = (measure(obj, scan.exposures, oversample) for obj in (cloud, fit.result().object))
        measured = torch.from_numpy(scan.frames)
        gain = float((after - measured).abs().mean() / (before - measured).abs().mean())
        assert gain < 0.95, name
        found[name] = (len(fit.result().object), round(gain, 3))
    assert len(set(found.values())) == len(found), found


def test_conjugate_gradients_solve_what_they_are_given(scripts):
    factor = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix, right = factor @ factor.T + torch.eye(6), torch.arange(6.0, dtype=torch.float64)
    found = scripts["second_order"].conjugate_gradients(lambda v: matrix @ v, right)
    torch.testing.assert_close(matrix @ found, right, rtol=1e-6, atol=1e-6)


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


def test_a_cell_in_optical_tweezers(scripts):
    """Two of the ten forces of Dao (2003) and Mills (2004), with their bounds, on a coarse mesh."""
    found = scripts["tweezers"].stretch(Membrane(resting_cell(3)), [47e-12, 109e-12])
    for s, (axial, transverse) in zip(found, (((10.82, 12.97), (4.29, 5.83)), ((12.87, 15.82), (3.98, 5.23)))):
        assert axial[0] <= 1e6 * s.axial <= axial[1]
        assert transverse[0] <= 1e6 * s.transverse <= transverse[1]
        assert abs(s.area) < 0.01
        assert abs(s.volume) < 0.01
        assert s.residual < 1e-14
    with pytest.raises(InputError, match="forces must rise"):
        scripts["tweezers"].stretch(Membrane(resting_cell(3)), [2e-11, 1e-11])


def test_measures_of_the_shapes_of_cells(scripts):
    flow = scripts["espresso_flow"]
    nodes = resting_cell(4).vertices
    turn, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = np.stack([nodes @ turn.T + 3e-6, nodes * [1.5, 1, 1]])
    assert flow.shape_change(moved, nodes)[0] < 1e-12
    assert flow.elongation(nodes) == pytest.approx(0, abs=2e-3)
    assert flow.elongation(moved)[1] == pytest.approx(0.2, abs=2e-3)  # (1.5 - 1)/(1.5 + 1)
    pulled = flow.shape_change(moved, nodes)[1]
    assert pulled == pytest.approx(np.sqrt(((0.5 * nodes[:, 0]) ** 2).mean()), rel=1e-6)  # no turn fits better
    _, axes = flow.gyration_axes(moved)
    assert abs(axes[1, 0, 2]) == pytest.approx(1, abs=1e-6)


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
    projected = script.projection(2, 1e-6)
    assert projected["apart"] < 1e-12
    assert projected["cpu"] > 0
    report = {"rows": rows, "accuracy": [errors], "projection": [projected], "load": 0.5, "commit": "abc"}
    report |= script.environment("reference")
    assert "| frames | 48² of 1 µm | 6 | 4 |" in script.table(report)
    assert "| voxels | 48³ of 1 µm | – | – |" in script.table(report)
    assert "| samples a pixel | C++ / s |" in script.table(report)


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


def test_every_variant_of_surfaces_changes_something(scripts):
    surfaces, changed = scripts["surfaces"], scripts["changes"].changed
    found = {}
    for name, changes in surfaces.VARIANTS.items():
        of_fit = {k: v for k, v in changes.items() if k not in ("spacing", "coarser")}
        found[name] = (changed(surfaces.SurfaceFit(), of_fit), changes.get("spacing"), changes.get("coarser"))
    assert found.pop("as they are") == (surfaces.SurfaceFit(), None, None)
    assert (surfaces.SurfaceFit(), None, None) not in found.values()
    assert found["40 steps"][0].schedule.steps == 40
    assert found["no smoothness"][0].curvature == 0


def test_what_cases_of_learned_starts_are_told(scripts):
    """The same scene with noise in the frames for training alone, or without its material."""
    learned = scripts["learned"]
    plain, noisy, untold = (learned.setting(f"cells{end}", None, 0, 2) for end in ("", "-noise", "-unknown"))
    for other in (noisy, untold):
        assert np.array_equal(other.scan.test().frames, plain.scan.test().frames)
    assert np.array_equal(untold.scan.frames, plain.scan.frames)
    deviation = (noisy.scan.train().frames - plain.scan.train().frames).std()
    assert 0.2 < deviation / plain.scan.train().frames.std() < 0.6
    assert [given.prior.kind for given in (plain, noisy, untold)] == ["known", "known", "free"]
    assert set(learned.CASES) >= {"espresso", "foam-noise", "espresso-unknown", "soft-cells-noise"}


def test_changed_options_must_exist(scripts):
    tune = scripts["tune_fields"]
    found = scripts["changes"].changed(tune.VoxelFit(), {"steps": 7, "floor": 0.3, "decay": 0.5})
    assert (found.steps, found.objective.floor, found.schedule.decay) == (7, 0.3, 0.5)
    assert found.schedule.steps == tune.VoxelFit().schedule.steps  # its own steps are what a name means
    with pytest.raises(KeyError, match="VoxelFit has no option flour"):
        scripts["changes"].changed(tune.VoxelFit(), {"flour": 0.3})


def test_the_conformal_quantile_covers_what_it_says(scripts):
    conformal_quantile = scripts["calibrate_intervals"].conformal_quantile
    assert conformal_quantile(np.arange(9.0), 0.9) == 8
    assert conformal_quantile(np.arange(8.0), 0.9) == np.inf
    assert conformal_quantile(np.arange(99.0), 0.9) == 89
    draws = np.random.default_rng(0).exponential(size=(2000, 40))
    inside = [each[-1] <= conformal_quantile(each[:-1], 0.9) for each in draws]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.02)


def test_the_floor_is_that_of_the_shortest_intervals_and_they_cover_scenes_that_were_not_seen(scripts):
    """Errors of scenes good and bad, of their scale: good ones get intervals as short as their own would be."""
    fitted_factor = scripts["calibrate_intervals"].fitted_factor
    rng, inside, short = np.random.default_rng(1), [], []
    for _ in range(300):
        scales = np.exp(rng.choice([-4.0, 0.0], 60, p=[0.4, 0.6]) + 0.3 * rng.normal(size=60))
        errors = scales * rng.normal(size=60)
        of = fitted_factor(errors[:-20], scales[:-20], np.ones(40))
        reach = np.array([of.reach(scale, 1.0) for scale in scales[-20:]])
        inside.extend(np.abs(errors[-20:]) <= reach)
        short.append(reach[scales[-20:] < 0.1].mean())
    assert np.mean(inside) == pytest.approx(0.9, abs=0.02)
    assert np.mean(short) < 0.15
    of = fitted_factor(np.array([0.0, 2.0]), np.array([0.0, 1.0]), np.ones(2))
    assert (of.floor, of.factor, of.scenes, of.power) == (1.0, 1.0, 2, 0)


def test_scales_count_times_the_excess_where_errors_grow_with_it(scripts):
    fitted_factor, rng = scripts["calibrate_intervals"].fitted_factor, np.random.default_rng(1)
    scales, excess = np.exp(rng.normal(size=200)), np.exp(np.abs(rng.normal(size=200)))
    errors = scales * rng.normal(size=200)
    assert fitted_factor(excess * errors, scales, excess).power == 1
    plain = fitted_factor(errors, scales, excess)
    assert plain.power == 0
    assert plain.reach(2.0, 3.0) == plain.reach(2.0, 1.0) == pytest.approx(plain.factor * (2.0 + plain.floor))
    assert fitted_factor(excess * errors, scales, excess).reach(2.0, 0.5) < plain.reach(1e3, 1.0)
