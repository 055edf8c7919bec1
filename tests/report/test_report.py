"""The report: self-contained, well formed, complete with and without data, and honest surfaces."""

import base64
import math
import re
from pathlib import Path
from runpy import run_path
from urllib.parse import unquote

import matplotlib
import numpy as np
import pytest
from matplotlib.contour import QuadContourSet

from helpers.pictures import undrawn
from helpers.report_page import BARE, DELTA, PITCH, Page, ball, content, scene
from holosplat.checks import InputError
from holosplat.geometry import Grid
from holosplat.metrics import volume_scores
from holosplat.report import (
    HeldOutViews,
    ProjectedMaps,
    render_page,
    render_surface,
    write_report,
)
from holosplat.report.curves import histogram_figure
from holosplat.report.figures import richest_planes, scene_figure, slices_figure
from holosplat.report.style import GROUND, INK, data_uri
from holosplat.report.surface import Deviation, camera
from holosplat.units import in_percent
from holosplat.volume import Volume

HERO = Path(__file__).parents[2] / "docs" / "pictures" / "hero.py"


@pytest.fixture(scope="module")
def full_page():
    return render_page(content())


@pytest.fixture(scope="module")
def bare_page():
    return render_page(content(**BARE))


# --- the page ---


def test_full_report_holds_every_figure_and_nothing_external(full_page):
    page = Page(full_page)
    assert len(page.sources) == 7
    assert all(source.startswith("data:image/") for source in page.sources)
    plain = re.sub(r'"data:[^"]*"', "", full_page)
    assert "http" not in plain
    assert "@import" not in full_page
    assert "url(" not in plain
    assert "<script" not in full_page
    assert [f"Figure {k} |" in page.text for k in range(1, 9)] == [True] * 7 + [False]
    for words in (
        "SSIM",
        "FRCM",
        "PSNR",
        "Dice",
        "fit.steps",
        "abc123",
        "θ = 10.0°",
        "1.00e-3",
        "Two balls & a <test>",
    ):
        assert words.replace("1.00e-3", "0.001") in page.text


def test_images_are_decodable_and_svg_loads_nothing(full_page):
    for source in Page(full_page).sources:
        kind, data = source.split(",", 1)
        if kind.endswith("base64"):
            assert base64.b64decode(data).startswith(b"\x89PNG")
        else:
            links = re.findall(r'(?:href|src)="([^"]*)"', unquote(data))
            assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)


def test_every_entry_of_the_contents_leads_to_a_section(full_page):
    page = Page(full_page)
    assert len(page.links) == 9  # seven figures, scores, record
    assert set(page.links) <= set(page.ids)


def test_figures_have_the_colours_of_dark_pages_and_images_keep_theirs():
    figure = slices_figure(*scene()[::-1], richest_planes(scene()[0]))
    drawn = unquote(data_uri(figure))
    assert "prefers-color-scheme: dark" in drawn
    assert not re.search(f": ({INK}|{GROUND})(?!;--|;}})", drawn.split("</style>", 1)[1])
    assert drawn.count("data:image/png;base64,") >= 9
    assert "#ffffff" in drawn  # a scale bar on a dark image


def test_slices_enclose_what_all_views_show():
    """Where all is shown, or nothing of a plane, there is no line."""
    truth, found = scene()
    planes = richest_planes(truth)
    seen = np.zeros(truth.grid.shape, dtype=bool)
    seen[:, 3:-2, 4:-5] = True
    figure = slices_figure(found, truth, planes, seen=seen)
    lines = [[c for c in axes.collections if isinstance(c, QuadContourSet)] for axes in figure.axes]
    assert sum(map(len, lines)) == 9  # three planes of truth, reconstruction and difference
    (drawn,) = lines[0][0].get_paths()
    low, high = drawn.vertices.min(axis=0) / PITCH, drawn.vertices.max(axis=0) / PITCH
    np.testing.assert_allclose(low, (4, 3), atol=0.51)
    np.testing.assert_allclose(high, (28 - 5, 20 - 2), atol=0.51)
    for everything in (np.ones_like(seen), None):
        figure = slices_figure(found, truth, planes, seen=everything)
        assert not any(isinstance(c, QuadContourSet) for axes in figure.axes for c in axes.collections)


def test_slices_of_one_row_have_a_line_too():
    volumes = []
    for each in scene():
        grid = Grid((each.grid.shape[0], 1, each.grid.shape[2]), each.grid.voxel_size, each.grid.origin)
        volumes.append(Volume(each.delta[:, 9:10], each.beta[:, 9:10], grid))
    seen = np.zeros(volumes[0].grid.shape, dtype=bool)
    seen[..., 4:-5] = True
    figure = slices_figure(volumes[1], volumes[0], richest_planes(volumes[0]), seen=seen)
    assert any(isinstance(c, QuadContourSet) for axes in figure.axes for c in axes.collections)


def test_the_report_says_how_much_matter_some_views_miss(undrawn_reports):
    truth, _ = scene()
    seen = np.zeros(truth.grid.shape, dtype=bool)
    seen[:, : truth.grid.shape[1] // 2] = True
    share = float(truth.delta[~seen].sum() / truth.delta.sum())
    page = Page(render_page(content(reconstruction=truth, seen=seen))).text
    assert f"Beyond it lies {in_percent(share)} of the matter" in page
    for all_of_it in (None, np.ones_like(seen)):
        assert "dashed line" not in Page(render_page(content(seen=all_of_it))).text


def test_bare_report_says_what_is_absent(bare_page):
    page = Page(bare_page)
    assert len(page.sources) == 3  # scene, slices, histograms
    for words in (
        "No view was held out and no truth is known",
        "no prediction could be tested",
        "No line integrals",
        "nothing to correlate",
        "No course of the fit",
        "neither a held-out view nor a truth",
        "light of the frames was taken to be even",
    ):
        assert words in page.text


@pytest.mark.parametrize(
    ("changes", "figures"),
    [
        ({"held_out": None, "projections": None}, 5),
        ({"truth": None, "volume_scores": None}, 7),
        ({"truth": None, "volume_scores": None, "projections": None, "history": {"step": np.arange(3.0)}}, 5),
    ],
)
def test_any_part_may_be_absent(changes, figures, undrawn_reports):
    if changes.get("truth", 1) is None and "projections" not in changes:
        maps = content().projections
        changes = changes | {"projections": ProjectedMaps(maps.projected_beta, maps.projected_delta, maps.labels)}
    assert len(Page(render_page(content(**changes))).sources) == figures


def test_the_page_says_of_which_run_it_is(bare_page, undrawn_reports):
    assert "holosplat-run" not in bare_page
    page = render_page(content(**BARE, run='0"1'))
    assert '<meta name="holosplat-run" content="0&#34;1">' in page


def test_empty_reconstruction_and_no_beta_are_reported():
    truth, found = scene()
    zero = np.zeros_like(found.delta)
    empty = content(**BARE, reconstruction=Volume(zero, zero, found.grid))
    text = Page(render_page(empty)).text
    assert "no surface is drawn" in text
    assert "there are no values to show" in text
    plain = Volume(found.delta, zero, found.grid)
    known = Volume(truth.delta, zero, truth.grid)
    pure = content(reconstruction=plain, truth=known, volume_scores=volume_scores(plain, known))
    with undrawn():
        assert "β is zero in all matter" in Page(render_page(pure)).text


def test_negative_contrast_is_drawn():
    truth, found = (Volume(-v.delta, v.beta, v.grid) for v in scene())
    _, outside = histogram_figure(found, truth, -DELTA)
    assert outside is not None
    assert outside < 0.05
    for figure in (scene_figure(found, truth, -DELTA), slices_figure(found, truth, richest_planes(truth))):
        picture = data_uri(figure, "png")
        assert len(picture) > 20_000


@pytest.mark.parametrize(("other", "colours"), [(-0.5, "RdBu_r"), (-1e-4, "magma"), (-3.0, "RdBu_r")])
def test_matter_on_both_sides_of_its_medium_is_drawn_around_white(other, colours):
    """Less of it than one colour stands for is rounding."""
    found, _ = scene()
    values = found.delta + np.roll(found.delta, len(found.delta) // 2, axis=0) * other
    both = Volume(values, found.beta, found.grid)
    image = slices_figure(both, None, richest_planes(both)).axes[0].images[0]
    assert image.get_cmap().name == colours
    low, high = image.get_clim()
    assert (low == -high) == (colours == "RdBu_r")


def test_equal_content_gives_equal_pages_and_leaves_matplotlib_alone(bare_page):
    before = dict(matplotlib.rcParams)
    assert render_page(content(**BARE)) == bare_page
    assert dict(matplotlib.rcParams) == before


def test_report_is_written_atomically(tmp_path, monkeypatch):
    monkeypatch.setattr("holosplat.report.page.render_page", lambda _: "<html></html>")
    path = tmp_path / "report.html"
    assert write_report(content(**BARE), path) == path
    assert path.read_text() == "<html></html>"
    monkeypatch.setattr("holosplat.io.atomic.os.replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(InputError, match="full"):
        write_report(content(**BARE), path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_mismatched_content_is_refused():
    truth, _ = scene((20, 20, 20))
    with pytest.raises(InputError, match="one grid"):
        content(truth=truth)
    with pytest.raises(InputError, match="one length"):
        content(history={"step": np.arange(3), "loss": np.arange(4)})
    held = content().held_out
    with pytest.raises(InputError, match="one label"):
        HeldOutViews(held.measured, held.predicted, held.labels[:1], held.scores)
    maps = content().projections
    with pytest.raises(InputError, match="or neither"):
        ProjectedMaps(maps.projected_beta, maps.projected_delta, maps.labels, true_projected_delta=maps.projected_delta)


def test_banner_has_its_size(undrawn_reports):
    truth, found = scene()
    figure = run_path(str(HERO))["hero_figure"](content().held_out.measured[0], PITCH, found, truth)
    assert tuple(figure.get_size_inches() * figure.dpi) == pytest.approx((1600, 500))


# --- surfaces ---


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_silhouette_of_a_ball_is_a_disc(sign):
    grid, radius = Grid.centred((48, 56, 44), PITCH), 1.5e-6
    shown = render_surface(sign * DELTA * ball(grid, radius), grid, sign * 0.5 * DELTA, size=160)
    area = shown.rgba[..., 3].sum() * shown.pixel_size**2
    assert area == pytest.approx(math.pi * radius**2, rel=0.02)
    assert np.all((shown.rgba >= 0) & (shown.rgba <= 1))


def test_surfaces_are_deterministic_and_lit_from_above():
    grid = Grid.centred((40, 40, 40), PITCH)
    values = ball(grid, 1.2e-6)
    first, second = (render_surface(values, grid, 0.5, size=96) for _ in range(2))
    assert np.array_equal(first.rgba, second.rgba)
    brightness = first.rgba[..., :3].mean(axis=-1) * (first.rgba[..., 3] > 0.99)
    assert brightness[:48].sum() > 1.2 * brightness[48:].sum()


def test_camera_agrees_with_a_hologram_of_the_same_rotation():
    """A ball at (x, y, z) appears where the view's rotation puts it: columns to the right, rows down."""
    grid, centre = Grid.centred((64, 64, 64), PITCH), np.array([1.0e-6, -1.2e-6, 0.5e-6])
    rotation = camera(40.0, 20.0)
    shown = render_surface(ball(grid, 6e-7, centre), grid, 0.5, rotation, size=128)
    rows, columns = np.nonzero(shown.rgba[..., 3] > 0.5)
    found = (np.array([columns.mean(), rows.mean()]) + 0.5) * shown.pixel_size - 0.5 * shown.width
    assert found == pytest.approx((rotation @ centre)[:2], abs=0.5 * PITCH)


def test_nearer_matter_hides_what_lies_behind():
    grid = Grid.centred((48, 32, 32), PITCH)
    near, far = (ball(grid, 6e-7, (0, 0, z)) for z in (-1.4e-6, 1.4e-6))
    both = render_surface(np.maximum(near, far), grid, 0.5, np.eye(3), size=96)
    alone = render_surface(near, grid, 0.5, np.eye(3), size=96)
    assert np.abs(both.rgba[..., 3] - alone.rgba[..., 3]).max() < 0.3
    inner = alone.rgba[..., 3] > 0.99
    assert np.abs(both.rgba - alone.rgba)[inner].max() < 0.1


def test_thin_long_voxels_and_empty_volumes():
    grid = Grid((30, 60, 60), (1e-7, 1e-7, 2e-7), (-2.95e-6, -2.95e-6, -2.9e-6))
    radius = 1.6e-6
    shown = render_surface(ball(grid, radius), grid, 0.5, camera(60.0, 10.0), size=128)
    assert shown.rgba[..., 3].sum() * shown.pixel_size**2 == pytest.approx(math.pi * radius**2, rel=0.03)
    assert not render_surface(np.zeros(grid.shape), grid, 0.5, size=32).rgba[..., 3].any()
    with pytest.raises(InputError, match="surface level"):
        render_surface(np.zeros(grid.shape), grid, 0.0)


def test_deviation_measures_the_distance_between_surfaces():
    grid, seen = Grid.centred((40, 40, 40), PITCH), []

    def remember(distance):
        seen.append(distance)
        return np.ones((len(distance), 3))

    for grown in (0.4 * PITCH, -0.4 * PITCH, 5 * PITCH):
        paint = Deviation(ball(grid, 1.2e-6), 0.5, PITCH, remember)
        render_surface(ball(grid, 1.2e-6 + grown), grid, 0.5, size=64, colour=paint)
    assert np.median(seen[0]) == pytest.approx(0.4, abs=0.06)
    assert np.median(seen[1]) == pytest.approx(-0.4, abs=0.06)
    assert np.all(seen[2] == 1.0)
