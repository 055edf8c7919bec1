"""What the report shows of bodies in motion, against the bodies themselves."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.moving_ellipsoids import PIXEL, STEP, TIMES, scan, true_paths, truth
from holosplat.bodies.rest_shape import centroid
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.report.content import Moving, ReportContent
from holosplat.report.moving_figures import (
    encode_animation,
    film_figure,
    motion_blocks,
    shapes_figure,
    trajectories_figure,
)
from holosplat.report.page import score_tables, verdict
from holosplat.report.run import moving_of
from holosplat.report.style import new_figure
from holosplat.report.surface import body_colours, paint_bodies
from holosplat.representations import SurfaceMesh
from holosplat.specimens.red_cells import icosphere
from holosplat.volume import Volume
from holosplat.workflows.reconstruction import Reconstruction


@cache
def moving(errors: float = 0.0) -> Moving:
    """The true bodies beside their frames; errors: standard errors as a share of volumes, 0 for none."""
    done = Reconstruction(true_paths(), "track", 20.0, 2, {}, True)
    found = moving_of(done, scan(), None)
    if not errors:
        return found
    return moving_of(done, scan(), None, {"volume_m3": errors * found.tracks["volume_m3"]})


def content(shown: Moving | None) -> ReportContent:
    grid = Grid.of_views(scan().views, 0.3)
    empty = np.zeros(grid.shape, dtype=np.float32)
    return ReportContent("tracked", Volume(empty, empty, grid), 20.0, PIXEL, moving=shown)


def painted(meshes, views: Views, colours) -> np.ndarray:
    """[H, W, 3] bodies on white, in pixels of the view."""
    rows, columns = views.shape
    figure = new_figure(columns / 10, rows / 10, "none")
    figure.set_dpi(10)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    paint_bodies(axes, meshes, views.rotations[0], views.shifts[0], colours)
    half = 0.5e6 * PIXEL
    axes.set(xlim=(-half * columns, half * columns), ylim=(half * rows, -half * rows))
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0  # type: ignore[attr-defined]


def test_painted_bodies_cover_what_they_project_to():
    """In views that are turned and shifted, on a rectangular detector of odd sides."""
    views = replace(Views.from_angles([35.0], (37, 31), PIXEL), shifts=np.array([[2.4e-6, -3.1e-6]]))
    mesh = true_paths().bodies(2 * STEP)[0]
    body = SurfaceMesh(torch.from_numpy(mesh.vertices / PIXEL), torch.from_numpy(mesh.faces), PIXEL, Matter.one(1.0, 0))
    thick = body.project(views).channels[0, 0].numpy() > 0.3 * PIXEL
    covered = painted([mesh], views, [(0.5, 0.0, 0.0)]).mean(-1) < 0.75
    assert 50 < thick.sum() < 0.5 * thick.size
    assert (thick & covered).sum() > 0.85 * (thick | covered).sum()


def test_the_nearer_body_hides_the_other():
    """Along the beam, +z; whichever is first in the list."""
    sphere, faces = icosphere(2)
    near, far = (TriangleMesh(4e-6 * sphere + np.array([0, 0, z]), faces) for z in (-9e-6, 9e-6))
    view, (red, blue) = Views.from_angles([0.0], (17, 21), PIXEL), ((1.0, 0, 0), (0, 0, 1.0))
    for meshes, colours in (([near, far], [red, blue]), ([far, near], [blue, red])):
        middle = painted(meshes, view, colours)[8, 10]
        assert middle[0] > 0.5 > middle[2] + 0.2


def test_bodies_have_their_own_colours():
    assert len(set(body_colours(21))) == 21


def test_numbers_of_bodies_are_those_at_all_times():
    shown = moving()
    assert shown.tracks["volume_m3"].shape == (TIMES, 3)
    for t in range(TIMES):
        way = centroid(shown.bodies.bodies(t * STEP)[1])
        assert [shown.tracks[f"{axis}_m"][t, 1] for axis in "xyz"] == pytest.approx(way, abs=1e-12)
    assert shown.whole[:, :2].all()
    assert not shown.whole[-1, 2]  # it leaves
    assert shown.mean("volume_m3")[0] == pytest.approx(shown.tracks["volume_m3"][:, 0].mean(), abs=0)
    assert (shown.high - shown.low) == pytest.approx(PIXEL * np.array([30, 37, 30]), abs=0)
    assert np.array_equal(shown.measured, scan().frames[:: len(scan()) // TIMES])
    assert np.abs(shown.predicted - shown.measured).mean() < 0.5 * np.abs(1 - shown.measured).mean()


def test_ways_are_drawn_where_bodies_are():
    figure = trajectories_figure(moving())
    for axes, across in zip(figure.axes, "xz"):
        lines = [line for line in axes.lines if len(line.get_xdata()) == TIMES]  # type: ignore[arg-type]
        assert len(lines) == 2 * 3
        assert lines[2].get_xdata() == pytest.approx(1e6 * moving().tracks[f"{across}_m"][:, 1], abs=0)
        assert lines[2].get_ydata() == pytest.approx(1e6 * moving().tracks["y_m"][:, 1], abs=0)
        box = axes.patches[0].get_bbox()  # type: ignore[attr-defined]
        assert (box.width, box.height) == pytest.approx((30, 37))


def test_shapes_have_bands_where_errors_are_known():
    without, with_them = shapes_figure(moving()), shapes_figure(moving(0.02))
    assert [len(axes.collections) for axes in without.axes] == [0, 0, 0]
    assert [len(axes.collections) for axes in with_them.axes] == [3, 0, 0]
    (band,) = with_them.axes[0].collections[0].get_paths()
    volume = 1e18 * moving().tracks["volume_m3"][:, 0]
    assert np.ptp(np.asarray(band.vertices)[:, 1]) == pytest.approx(1.02 * volume.max() - 0.98 * volume.min())


def test_a_film_strip_shows_frames_and_what_is_left():
    figure, shown = film_figure(moving()), moving()
    images = [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images]
    stack = np.array([image for image in images if image.shape == shown.measured.shape[1:]])
    assert len(stack) == 3 * TIMES
    assert any(np.allclose(one, shown.measured[-1]) for one in stack)
    assert any(np.allclose(one, shown.predicted[-1]) for one in stack)
    left = (shown.predicted[-1] - shown.measured[-1]).astype(float)
    assert max(np.corrcoef(left.ravel(), one.ravel())[0, 1] for one in stack.astype(float)) > 0.9999


def test_moving_pictures_are_bounded_and_move():
    """Noise does not compress, so that quality and then size must fall; a dot that moves is where it should be."""
    noise = np.random.default_rng(0).integers(0, 255, (6, 120, 160, 3)).astype(np.uint8)
    small, large = (encode_animation(list(noise), 0.1, most) for most in (20_000, 400_000))
    assert len(small) <= 20_000 < len(large) <= 400_000
    dots = np.zeros((4, 48, 64, 3), dtype=np.uint8)
    for k in range(4):
        dots[k, 20:28, 10 + 12 * k : 18 + 12 * k] = 255
    picture = Image.open(io.BytesIO(encode_animation(list(dots), 0.1, 400_000)))
    assert (picture.size, picture.n_frames) == ((64, 48), 4)  # type: ignore[attr-defined]
    for k in range(4):
        picture.seek(k)
        light = np.asarray(picture.convert("L")).astype(float)
        assert light.sum(0) @ np.arange(64) / light.sum() == pytest.approx(13.5 + 12 * k, abs=2)


def test_the_page_moves():
    """The first block is a picture of all times."""
    (first, *others) = motion_blocks(moving(0.02))
    assert [block.heading for block in (first, *others)] == ["Motion", "Film strip", "Ways", "Shapes"]
    found = re.fullmatch(r"data:image/webp;base64,(.+)", first.image or "")
    assert found is not None
    picture = Image.open(io.BytesIO(base64.b64decode(found[1])))
    assert picture.n_frames == TIMES  # type: ignore[attr-defined]
    assert "standard errors" in others[-1].caption


def test_the_page_says_how_bodies_are():
    shown = moving(0.02)
    assert "follows 3 bodies through 5 times" in verdict(content(shown))
    table = score_tables(content(shown))[0]
    volume = 1e18 * truth().snapshots[0].meshes[0].volume
    said, error = table.rows[0][3].split(" ± ")
    assert float(said) == pytest.approx(volume, rel=0.05)
    assert float(error) == pytest.approx(0.02 * float(said), abs=0.02)
    assert table.rows[2][1] == str(int(shown.whole[:, 2].sum()))
