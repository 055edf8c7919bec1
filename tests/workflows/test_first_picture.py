"""The first picture: a coarse volume before all work, which changes no result."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch

from helpers.cli import QUICK
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.methods.cross_validation import first_picture
from holosplat.progress import PICTURE
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.volume import Volume
from holosplat.workflows import reconstruct as workflow
from holosplat.workflows.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("unjudged_runs")
CELL = HAEMOGLOBIN.delta_beta(20.0)
PRIORS = (MaterialPrior.known(CELL), MaterialPrior.of_ratio(CELL.delta / CELL.beta), MaterialPrior.unknown())


def odd(rows: int = 51, columns: int = 67, pixel: float = 1e-6) -> tuple[Scan, Volume]:
    """A rectangular scan, and its matter on the voxels of its first picture."""
    views = Views.evenly_spaced(6, (rows, columns), pixel)
    cells = random_cells(2, (columns * pixel, rows * pixel, columns * pixel), 1, 0.3 * rows * pixel)
    scene = MeshScene.of_one_material(cells, CELL)
    scan = simulate(scene, Exposures.of(views, 20.0, 0.02), is_test=np.zeros(6, dtype=bool))
    return scan, scene.voxelise(first_picture(scan, PRIORS[0]).grid)


@pytest.mark.parametrize("prior", PRIORS, ids=["known", "ratio", "unknown"])
def test_it_is_a_coarse_volume_of_the_matter_and_draws_nothing_random(prior):
    scan, truth = odd()
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    found = first_picture(scan, prior)
    assert torch.equal(before[0], torch.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    assert max(found.grid.shape) <= 48
    volume = found.voxelise(found.grid)
    error = 1.0 if prior is PRIORS[2] else 0.5  # of a ratio that is not known
    assert volume.delta.sum() == pytest.approx(truth.delta.sum(), rel=error)
    assert np.corrcoef(np.ravel(volume.delta), np.ravel(truth.delta))[0, 1] > 0.5


def test_the_callback_is_first_given_it_and_the_result_is_the_same_bit_for_bit():
    scan, _ = odd(19, 23, 3e-6)
    seen = list[tuple[str, dict[str, float], object]]()
    plain = reconstruct(scan, PRIORS[0], QUICK, matter="levels")
    shown = reconstruct(
        scan,
        PRIORS[0],
        QUICK,
        matter="levels",
        on_state=lambda stage, part, record, state: seen.append((stage, record, state())),
    )
    stages = [stage for stage, _, _ in seen]
    assert stages[:2] == [PICTURE, "start"]
    assert stages.count(PICTURE) == 1
    assert isinstance(seen[0][2], VoxelGrid)
    assert any(record for _, record, _ in seen)
    for name, value in plain.object.parameters().items():
        assert torch.equal(value, shown.object.parameters()[name])


def test_where_there_can_be_none_it_is_said_and_the_run_goes_on(monkeypatch, caplog):
    scan, _ = odd(19, 23, 3e-6)

    def refuses(train, prior):
        raise InputError("frames cannot be retrieved.")

    monkeypatch.setattr(workflow, "first_picture", refuses)
    seen = list[str]()
    with caplog.at_level(logging.INFO, "holosplat"):
        done = reconstruct(scan, PRIORS[0], QUICK, matter="levels", on_state=lambda stage, *rest: seen.append(stage))
    assert done.finished
    assert "there is no first picture: frames cannot be retrieved." in caplog.text
    assert PICTURE not in seen
    assert "start" in seen
