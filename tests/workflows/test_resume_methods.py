"""Every fitted method, stopped in any of its stages, goes on from its run folder as if nothing had happened."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from helpers.runs import KNOWN, PIXEL, RANDOM, scene
from helpers.short import in_one_go
from helpers.two_balls import NETWORK
from helpers.unjudged import unjudged
from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.fit import run as engine
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Views
from holosplat.io.objects import read_object
from holosplat.matter import MaterialPrior
from holosplat.methods import (
    FitOptions,
    Gaussians,
    HolographicVoxels,
    Method,
    PerView,
    SmoothVolume,
    SurfaceFit,
    Surfaces,
    VoxelFit,
    Voxels,
)
from holosplat.methods.coarse import CoarseToFine
from holosplat.scan import Exposures, Scan
from holosplat.volume import Object
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import OBJECT_SUM, RunFolder
from holosplat_bench.opponents.fields import AlignedNetwork, NeuralField
from holosplat_bench.opponents.neural_fields import NeuralFields, NeuralFit
from holosplat_bench.opponents.onix import AlignedFit, Onix

VOLUME = HolographicTV(iterations=30, corrections=2, inner=8, refine=1)
CLOUD = Gaussians(
    spacing_px=2.0,
    approximate_steps=5,
    volume=VOLUME,
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=12)),
    coarse=CoarseToFine(coarse_steps=2, views=1, turns=1),
)
SURFACES = SurfaceFit(schedule=Schedule(steps=6, decay=0.1, views_per_step=2))
VOXELS = VoxelFit(coarse_steps=5, steps=7)
SMOOTH = SmoothVolume(replace(VOLUME, upper=0.0, noisy=1.0, beyond=False), coarser=(2,), rounds=2, iterations=2)
FIELD = NeuralFit(
    NETWORK,
    warmup_steps=20,
    warmup_rays=512,
    probes=512,
    prune_every=2,
    schedule=Schedule(steps=7, views_per_step=1, validation_views=1, validate_every=2),
)
ALIGNED = AlignedFit(network=AlignedNetwork((4, 6), 8, 2), schedule=Schedule(steps=4, views_per_step=2))


@dataclass(frozen=True)
class Case:
    """A method, and where it is stopped: the name of a stage and a step in it."""

    method: Method
    stage: str
    step: int
    first: tuple[str, ...] = ()
    """Files of the metrics of earlier stages."""


CASES = {
    "gaussians": Case(RANDOM, "fit", 5),
    "surfaces, in the Gaussians": Case(Surfaces(gaussians=CLOUD, fit=SURFACES), "fit", 4, ("metrics_0.csv",)),
    "surfaces": Case(Surfaces(gaussians=CLOUD, fit=SURFACES), "surfaces", 3, ("metrics_0.csv",)),
    "voxels, coarse": Case(Voxels(VOLUME, VOXELS), "voxels through the waves, coarse", 3, ("metrics_1.csv",)),
    "voxels": Case(Voxels(VOLUME, VOXELS), "voxels through the waves", 4, ("metrics_1.csv",)),
    "volume, coarse": Case(SMOOTH, "smooth volume", 3),
    "volume": Case(SMOOTH, "smooth volume", 9),
    "neural-field": Case(NeuralFields(VOLUME, FIELD), "field through the waves", 3),
    "onix": Case(Onix(ALIGNED), "pixel-aligned field through the waves", 3),
}


@pytest.fixture(scope="module", autouse=True)
def _unjudged() -> Iterator[None]:
    with unjudged(), in_one_go():
        yield


@pytest.fixture(scope="module", params=CASES)
def case(request) -> Case:
    return CASES[request.param]


@pytest.fixture(scope="module")
def scan() -> Scan:
    """The cells on coarser pixels, as few as have coarser voxels, too."""
    views = Views.evenly_spaced(8, (25, 30), 1.6 * PIXEL)
    return simulate(scene(), Exposures.of(views, 20.0, 0.1), oversample=2)


@pytest.fixture(scope="module")
def wholes() -> dict[Method, RunFolder]:
    """Runs that nobody stopped; made once."""
    return {}


@pytest.fixture(scope="module")
def whole(scan, case, wholes, tmp_path_factory) -> RunFolder:
    """A run that nobody stopped."""
    if case.method not in wholes:
        wholes[case.method] = RunFolder(tmp_path_factory.mktemp("whole") / "run")
        reconstruct(scan, KNOWN, case.method, seed=3, folder=wholes[case.method])
    return wholes[case.method]


def stopping(case: Case, error: type[BaseException]):
    """A progress that raises at the case's stage and step."""

    def progress(stage: str, fraction: float, record: dict[str, float]) -> None:
        if stage == case.stage and record.get("step") == case.step:
            raise error

    return progress


def rows(path: Path) -> list[dict[str, str]]:
    """The rows of a table of metrics, without the clock."""
    with path.open(newline="") as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def assert_same(folder: RunFolder, whole: RunFolder, case: Case) -> None:
    """Bit for bit the same object, and the same metrics of all stages."""
    found, wanted = (read_object(each.object) for each in (folder, whole))
    assert (found.kind, found.described) == (wanted.kind, wanted.described)
    for name, value in wanted.parameters().items():
        assert torch.equal(found.parameters()[name], value), name
    if isinstance(wanted, NeuralField):
        assert isinstance(found, NeuralField)
        assert torch.equal(found.mask, wanted.mask)
    for name in ("metrics.csv", *case.first):
        assert rows(folder.path / name) == rows(whole.path / name), name
    assert {path.name for path in folder.path.iterdir()} == {path.name for path in whole.path.iterdir()}
    summaries = [json.loads(each.summary.read_text()) for each in (folder, whole)]
    for decision in (*summaries[0]["decisions"], *summaries[1]["decisions"]):
        decision["seconds"] = 0  # as the timing
    assert summaries[0]["timing_s"].keys() == summaries[1]["timing_s"].keys()
    same = {"timing_s": 0, "run": "", OBJECT_SUM: ""}  # which no two runs share: the object's file has the run's name
    assert summaries[0] | same == summaries[1] | same


def test_every_stage_has_its_metrics(case, whole):
    """Those of the last one in metrics.csv, of the others beside it."""
    assert {path.name for path in whole.path.glob("metrics*.csv")} == {"metrics.csv", *case.first}
    kind = "volume" if case.method is SMOOTH else load_reconstruction(whole).object.kind
    steps = {"surfaces": 6, "voxels": 7, "volume": 12, "neural-field": 7, "gaussians": 12, "pixel-aligned-field": 4}[
        kind
    ]
    assert [int(row["step"]) for row in rows(whole.metrics)] == list(range(1, steps + 1))
    assert all(math.isfinite(float(row["loss"])) for row in rows(whole.metrics))


def test_an_interrupted_run_is_usable_and_goes_on(scan, case, whole, tmp_path):
    folder = RunFolder(tmp_path / "run")
    half = reconstruct(scan, KNOWN, case.method, seed=3, folder=folder, on_progress=stopping(case, KeyboardInterrupt))
    assert not half.finished
    summary = json.loads(folder.summary.read_text())
    assert (summary["finished"], summary["steps"]) == (False, case.step)
    assert load_reconstruction(folder).object.kind == half.object.kind == summary["kind"]
    stages: list[str] = []
    done = reconstruct(
        scan,
        KNOWN,
        case.method,
        seed=3,
        folder=folder,
        resume=True,
        on_progress=lambda stage, fraction, record: stages.append(stage),
    )
    assert done.finished
    assert stages[0] == case.stage, "nothing before it is done again"
    assert_same(folder, whole, case)


def test_a_run_that_died_goes_on_from_its_last_checkpoint(scan, case, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 0.0)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(RuntimeError):
        reconstruct(scan, KNOWN, case.method, seed=3, folder=folder, on_progress=stopping(case, RuntimeError))
    reconstruct(scan, KNOWN, case.method, seed=3, folder=folder, resume=True)
    assert_same(folder, whole, case)


# --- what a reconstruction gives ----------------------------------------------------------------------------

UNFITTED = {
    "holographic-tv": HolographicVoxels(VOLUME),
    "per-view": PerView("paganin", "fbp", bounded=False),
    "no steps": replace(CLOUD, fit=replace(CLOUD.fit, schedule=Schedule(steps=0))),
}


@pytest.mark.parametrize("name", UNFITTED)
def test_a_method_without_a_fit_is_an_object_all_the_same(scan, tmp_path, name):
    folder = RunFolder(tmp_path / "run")
    found = reconstruct(scan, KNOWN, UNFITTED[name], folder=folder)
    assert isinstance(found.object, Object)
    assert found.finished
    assert found.timing["start"] > 0
    assert rows(folder.metrics) == []
    loaded = load_reconstruction(folder)
    for key, value in found.object.parameters().items():
        assert torch.equal(loaded.object.parameters()[key], value)
    again = reconstruct(scan, KNOWN, UNFITTED[name], folder=folder, resume=True)
    assert again.object.described == found.object.described


@pytest.mark.parametrize("case_name", ["voxels", "neural-field"])
def test_with_nothing_known_delta_and_beta_are_free_in_files_too(scan: Scan, tmp_path, case_name):
    folder = RunFolder(tmp_path / "run")
    found = reconstruct(scan, MaterialPrior.unknown(), CASES[case_name].method, matter="levels", folder=folder)
    assert not found.object.matter.occupancies
    assert load_reconstruction(folder).object.matter == found.object.matter
