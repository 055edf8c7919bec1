"""The benchmark's pages: plots that keep their texts apart, and pages that are whole."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
from matplotlib.text import Text

from helpers.bench_rows import failed, make, results, row
from holosplat.checks import InputError
from holosplat.io.atomic import write_json
from holosplat_bench.suite.folder import REFERENCE, BenchFolder
from holosplat_bench.suite.pages.page import escaped
from holosplat_bench.suite.pages.pictures import Shown, holograms_figure, slices_figure
from holosplat_bench.suite.pages.plots import (
    SMALLEST,
    curves_figure,
    deficit,
    marks_of,
    overview_figure,
    pareto_front,
    tradeoff_figure,
)
from holosplat_bench.suite.pages.report import write_bench_report
from holosplat_bench.suite.pages.results import DICE, ERROR, SSIM

# --- plots --------------------------------------------------------------------------------------------------


def test_the_front_is_what_none_beats_in_both():
    points = [(1, 9), (2, 5), (3, 6), (4, 1), (2, 7), (9, 1)]
    assert pareto_front(points) == [(1, 9), (2, 5), (4, 1)]
    assert pareto_front([]) == []


def test_deficits_suit_a_logarithm():
    assert deficit(SSIM, 0.97) == pytest.approx(0.03)
    assert deficit(ERROR, 0.25) == 0.25
    assert deficit(DICE, 1.0) == SMALLEST


def arrays(seed: int = 0, shape: tuple[int, int] = (20, 27)) -> dict[str, np.ndarray]:
    """A picture of a method or of the truth."""
    rng = np.random.default_rng(seed)
    h, w = shape
    return {
        "xy": rng.random((h, w)),
        "xz": rng.random((w, w)),
        "zy": rng.random((h, w)),
        "planes": np.array([3, 4, 5]),
        "voxel_size": np.full(3, 1e-6),
        "material": np.array(2e-7),
        "frame": 1 + 0.1 * rng.random((h, w)),
        "index": np.array(1),
        "pixel_size": np.array(1e-6),
        "frequency": np.linspace(0.05, 0.5, 10),
        "frc": np.linspace(1, -0.2, 10),
        "shells": np.linspace(0.05, 0.5, 10),
        "fsc": np.linspace(1, 0.3, 10),
        "pitch": np.array(1e-6),
    }


def boxes(figure) -> list[tuple[str, tuple[float, float, float, float]]]:
    """Every visible text of a figure and its box (left, bottom, right, top), as parts of the figure."""
    figure.canvas.draw()
    whole = figure.bbox
    found = []
    for text in figure.findobj(Text):
        if text.get_text().strip() and text.get_visible():
            box = text.get_window_extent()
            found.append(
                (
                    text.get_text(),
                    (box.x0 / whole.width, box.y0 / whole.height, box.x1 / whole.width, box.y1 / whole.height),
                )
            )
    return found


LONG = (
    "paganin-sirt-nonneg",
    "gaussians-random",
    "hybrid-input-output-tv",
    "gaussians",
    "fbp",
    "sirt-nonneg",
    "svmbir",
)


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("kind", ["slices", "holograms"])
def test_titles_of_tiles_neither_overlap_nor_leave_the_page(kind, count):
    shown = [Shown(name, "Dice 0.974", arrays(i)) for i, name in enumerate(LONG[:count])]
    figure = (slices_figure if kind == "slices" else holograms_figure)(arrays(9), shown)
    titles = [(text, box) for text, box in boxes(figure) if text in (*LONG, "Dice 0.974", "truth", "measured")]
    assert len(titles) == 2 * count + 1
    for i, (text, box) in enumerate(titles):
        assert min(box) >= 0, text
        assert max(box) <= 1, text
        for other, (left, bottom, right, top) in titles[:i]:
            apart = box[0] >= right or box[2] <= left or box[1] >= top or box[3] <= bottom
            assert apart, (text, other)


TITLES = ("a", "b", "d", "SSIM", "Dice", "Held-out holograms", "Fourier ring correlation", "stored size (bytes)")


def test_plots_keep_their_texts_on_the_page(tmp_path):
    rows = [row(name, 0.5 + 0.06 * i, seconds=2.0**i, stored_bytes=1000 * 3**i) for i, name in enumerate(LONG)]
    rows.append(row("truth-on-voxels", 1.0, family=REFERENCE, test=dict(row("x", 0.97).test)))
    cases = results(tmp_path, rows)
    marks = marks_of(cases)
    curves = curves_figure({name: arrays(i) for i, name in enumerate(LONG)}, marks, 1e-6)
    for figure in (tradeoff_figure(cases[0], marks), overview_figure(cases, marks), curves):
        seen = boxes(figure)
        assert {name for name, _ in seen} >= set(LONG)
        inside = [
            (min(box) > -0.005 and max(box) < 1.005, text)
            for text, box in seen
            if text in (*LONG, *TITLES) or "−" in text
        ]
        assert all(good for good, _ in inside), inside
    assert curves_figure({}, marks, 1e-6) is None


def test_methods_are_told_apart_in_all_plots_alike(tmp_path):
    rows = [row(name, case=case) for case in ("a", "b") for name in LONG] + [row("extra", case="b")]
    marks = marks_of(results(tmp_path, rows))
    assert len({(m.colour, m.marker) for m in marks.values()}) == len(marks) == len(LONG) + 1


# --- pages --------------------------------------------------------------------------------------------------


NASTY = "it | needs *one* axis_of <b>rotation</b>,\nnot `two` & [none](x)"


class Checker(HTMLParser):
    """Whether elements are closed in order, and what a page would load."""

    VOID = ("meta", "img", "br", "link", "input", "hr")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.anchors: set[str] = set()
        self.targets: set[str] = set()

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.sources += [v for k, v in attrs if k == "src"]
        self.anchors |= {found["id"]} if "id" in found else set()
        self.targets |= {found["href"][1:]} if "href" in found else set()
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def full(tmp_path) -> BenchFolder:
    """Two methods, a failure and a reference on one case, with pictures and facts."""
    rows = [row("gaussians", 0.9), row("fbp", 0.7), failed("neural-field", NASTY)]
    rows.append(row("truth-on-voxels", 0.99, family=REFERENCE))
    folder = make(tmp_path, rows)
    for i, name in enumerate(("truth", "gaussians", "fbp", "truth-on-voxels")):
        sizes = {"diameters": np.array([6e-6, 3e-6, 1.5e-6]), "contrast": np.array([0.9, 0.7, 0.2])}
        folder.write_picture("ball", 101, name, arrays(i) | sizes)
    folder.case("ball", 101).mkdir()
    facts = {
        "summary": "A ball, alone",
        "detector": [20, 27],
        "pixel_size_m": 1e-6,
        "energy_kev": 20.0,
        "distance_m": [0.02, 0.05],
        "psf_sigma_px": [0.05, 0.05],
        "training_frames": 4,
        "held_out_frames": 2,
        "shares_axis": True,
        "photons": 2000.0,
        "prior": {"kind": "known", "delta": 2e-7, "beta": 2e-10, "ratio": 0.0},
    }
    write_json(folder.case("ball", 101) / "case.json", facts)
    return folder


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> tuple[str, str, BenchFolder]:
    """HTML, Markdown and folder of a full report."""
    folder = full(tmp_path_factory.mktemp("full"))
    html, markdown = write_bench_report(folder)
    return html.read_text(encoding="utf-8"), markdown.read_text(encoding="utf-8"), folder


def test_the_page_is_well_formed_and_needs_nothing_else(pages):
    checker = Checker()
    checker.feed(pages[0])
    assert checker.open == []
    assert len(checker.sources) == 6
    assert all(source.startswith("data:image/svg+xml,") for source in checker.sources)
    assert unquote(checker.sources[0]).rstrip().endswith("</svg>")
    assert checker.targets <= checker.anchors


def test_the_page_says_how_the_numbers_came_about(pages):
    html, markdown, _ = pages
    for text in (html, markdown):
        for words in (
            "abc1234",
            "101",
            "Rosenthal",
            "2,000 photons",
            "20 to 50 mm",
            "A ball, alone",
            "4 training frames",
        ):
            assert words in text, words
    assert "<b>rotation</b>" not in html


def test_markdown_links_its_pictures_beside_it(pages):
    _, markdown, folder = pages
    links = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", markdown)
    assert len(links) == 6
    assert all((folder.path / link).is_file() for link in links)
    assert not list(folder.path.rglob(".*"))


def test_markdown_tables_are_whole_whatever_the_cells_hold(pages):
    _, markdown, _ = pages
    tables = re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE)
    assert len(tables) >= 5
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1
    assert "- neural-field: failed: " + escaped(NASTY) in markdown
    assert "**0.900**" in markdown


def test_escaped_text_stays_on_one_line_and_means_itself():
    assert escaped("a|b\n*c*_d_<e>`f`[g]") == r"a\|b \*c\*\_d\_\<e\>\`f\`\[g\]"
    assert escaped("plain-name 3.0 (x)") == "plain-name 3.0 (x)"


def test_a_report_can_be_written_again_while_rows_come_in(tmp_path):
    folder = make(tmp_path, [row("fbp")])
    write_bench_report(folder)
    folder.write_row(row("gaussians", 0.97))
    html, _ = write_bench_report(folder)
    assert "gaussians 0.970" in html.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "rows", [[failed("fbp", "no")], [row("truth-on-voxels", family=REFERENCE)], [row("fbp", stored_bytes=None)]]
)
def test_little_in_the_folder_makes_a_page_too(tmp_path, rows):
    html, markdown = write_bench_report(make(tmp_path, rows))
    checker = Checker()
    checker.feed(html.read_text(encoding="utf-8"))
    assert checker.open == []
    assert "# Benchmark" in markdown.read_text(encoding="utf-8")


def test_folders_without_rows_are_refused(tmp_path):
    with pytest.raises(InputError, match="holds no row"):
        write_bench_report(make(tmp_path, []))
    with pytest.raises(InputError, match="does not exist"):
        write_bench_report(BenchFolder(tmp_path / "nowhere"))
    (tmp_path / "foreign").mkdir()
    with pytest.raises(InputError, match="holds other files"):
        write_bench_report(BenchFolder(tmp_path / "foreign"))


def test_a_damaged_picture_is_named(tmp_path):
    folder = full(tmp_path)
    (folder.pictures / "ball.101.fbp.npz").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"ball\.101\.fbp\.npz must be a picture"):
        write_bench_report(folder)
