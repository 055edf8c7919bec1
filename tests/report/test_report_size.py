"""The page of the main job is small enough to send: 24 cells on 128 × 128 pixels, and all that a run shows of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.matter import Matter
from holosplat.metrics import image_scores, intensity_range, volume_scores
from holosplat.model import measure
from holosplat.report import HeldOutViews, ProjectedMaps, ReportContent, view_labels, write_report
from holosplat.report.run import view_of
from holosplat.representations import SurfaceMesh
from holosplat.scan import Scan
from holosplat.specimens.red_cells import place_cells
from holosplat.workflows.demo import CELL_PX, CELLS, DETECTOR, PIXEL_SIZE, SEED
from holosplat_bench.suite.case import load_case

MOST = 3_000_000
"""Bytes: what a message still carries."""
TRIANGLES = 60_000
"""What a run ends with, at least."""
STEPS = np.arange(30)


def surfaces(matter: Matter) -> SurfaceMesh:
    """The demonstration's cells as closed surfaces, with as many triangles as a run ends with."""
    rows, columns = (n * PIXEL_SIZE for n in DETECTOR)
    placed = place_cells(CELLS, (columns, rows, columns), SEED, CELL_PX * PIXEL_SIZE)
    cells = [cell.mesh(subdivisions=3 + n % 2) for n, cell in enumerate(placed)]
    counts = np.cumsum([0, *(len(cell.vertices) for cell in cells)])
    faces = np.concatenate([cell.faces + count for cell, count in zip(cells, counts)])
    vertices = np.concatenate([cell.vertices for cell in cells]) / PIXEL_SIZE
    return SurfaceMesh(torch.from_numpy(vertices), torch.from_numpy(faces), PIXEL_SIZE, matter)


def content() -> ReportContent:
    """What a run shows that is wrong by a fifth of a pixel everywhere, so that no picture of differences is even."""
    case = load_case("main12")
    true = surfaces(Matter((case.prior.materials[0],)))
    moved = 0.2 * torch.randn(true.vertices.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found, truth = true.with_parameters({"vertices": true.vertices + moved}), case.truth()
    with torch.no_grad():
        scan = Scan(measure(true, case.exposures).numpy(), case.exposures, case.is_test)
        test, volume = scan.test(), found.voxelise(truth.grid)
        predicted = measure(found, test.exposures).numpy()
        shown = scan.views[np.arange(3)]
        maps = [[part.numpy() for part in each.project(shown)] for each in (found, true)]
    scores = image_scores(predicted, test.frames, intensity_range(test.frames))
    labels = view_labels(scan.views)
    return ReportContent(
        title="Cells",
        reconstruction=volume,
        truth=truth,
        energy_kev=scan.exposures.reference_energy,
        pixel_size=PIXEL_SIZE,
        held_out=HeldOutViews(test.frames, predicted, view_labels(test.views), scores),
        projections=ProjectedMaps(*maps[0], labels[:3], *maps[1]),
        volume_scores=volume_scores(volume, truth),
        material_delta=true.matter.delta,
        view=view_of(found, volume, truth, scan),
        history={"step": STEPS, "loss": np.exp(-STEPS / 9), "seconds": 0.4 * STEPS},
    )


@pytest.mark.slow
def test_the_page_of_the_main_job_has_at_most_three_megabytes(tmp_path):
    shown = content()
    assert shown.view is not None
    assert len(shown.view.parts["reconstruction"].arrays["faces"]) > TRIANGLES

    page = write_report(shown, tmp_path / "report.html")

    assert 1e6 < page.stat().st_size <= MOST
