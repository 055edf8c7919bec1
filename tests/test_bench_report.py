"""The benchmark's report: who is best, who is beaten, and pages that are whole with much or little in the folder."""

from __future__ import annotations

import base64
import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.text import Text

from holosplat.bench.folder import BenchFolder
from holosplat.bench.pages.marks import marks_of
from holosplat.bench.pages.page import escaped
from holosplat.bench.pages.pictures import Shown, holograms_figure, slices_figure
from holosplat.bench.pages.plots import (
    SMALLEST,
    curves_figure,
    deficit,
    overview_figure,
    pareto_front,
    tradeoff_figure,
)
from holosplat.bench.pages.report import write_bench_report
from holosplat.bench.pages.results import BYTES, DICE, ERROR, MEASURES, SECONDS, SSIM, beaten, read_results
from holosplat.bench.pages.text import beaten_table, case_table, summary_table, verdict, wins_table
from holosplat.bench.rows import REFERENCE, Row
from holosplat.checks import InputError
from holosplat.io.json import write_json

MEAN, RESOLUTION = MEASURES[5], MEASURES[6]
FAMILIES = {"fbp": "tomography", "sirt-nonneg": "tomography", "gaussians": "Gaussians", "neural-field": "neural"}


def row(method: str, quality: float = 0.9, *, case: str = "ball", seed: int = 101, **changes) -> Row:
    """A finished row whose scores all follow from `quality`."""
    values = {
        "family": FAMILIES.get(method, "others"),
        "place": list(FAMILIES).index(method) if method in FAMILIES else 9,
        "summary": f"{method} in a line",
        "status": "done",
        "reason": "",
        "scan_hash": "0123",
        "commit": "abc1234",
        "when": "2026-01-02T03:04:05+00:00",
        "seconds": 10 * quality,
        "stored_bytes": 20_000,
        "test": {"ssim": quality, "frcm": quality - 0.1, "psnr": 30 * quality, "l1": 0.01},
        "train": {"ssim": quality, "frcm": quality, "psnr": 30.0, "l1": 0.01},
        "volume": {
            "dice": quality,
            "relative_error_delta": 1 - quality,
            "delta_deviation": 0.5 * (quality - 0.9),
            "resolution_half": 4e-6 / quality,
            "pitch": 1e-6,
        },
        "versions": {"holosplat": "0", "torch": "2"},
        "machine": {"processor": "one"},
    }
    return Row(case=case, seed=seed, method=method, **(values | changes))


def failed(method: str, reason: str, seed: int = 101) -> Row:
    return row(method, seed=seed, status="failed", reason=reason, seconds=None, stored_bytes=None, test={}, volume={})


def make(path, rows: list[Row]) -> BenchFolder:
    folder = BenchFolder(path / "bench")
    folder.create()
    for one in rows:
        folder.write_row(one)
    return folder


def results(path, rows: list[Row]):
    return read_results(make(path, rows))


def names(methods) -> list[str]:
    return [method.name for method in methods]


# --- who is best --------------------------------------------------------------------------------------------


def test_the_best_is_the_highest_the_lowest_or_the_nearest_to_zero(tmp_path):
    (case,) = results(tmp_path, [row("fbp", 0.5), row("gaussians", 0.88), row("neural-field", 0.97)])
    assert names(case.best(SSIM)) == ["neural-field"]
    assert names(case.best(ERROR)) == ["neural-field"]
    assert names(case.best(SECONDS)) == ["fbp"]
    assert names(case.best(MEAN)) == ["gaussians"]  # -1 %, the others -20 % and +3.5 %
    assert names(case.best(BYTES)) == ["fbp", "gaussians", "neural-field"]


def test_what_cannot_be_told_apart_in_the_digits_shown_is_best_together(tmp_path):
    (case,) = results(tmp_path, [row("fbp", 0.90001), row("gaussians", 0.90002), row("neural-field", 0.8994)])
    assert names(case.best(SSIM)) == ["gaussians", "fbp"]
    bold = {r[0].text: r[1].best for r in case_table(case).rows}
    assert bold == {"fbp": True, "gaussians": True, "neural-field": False}


def test_references_compete_with_nobody(tmp_path):
    (case,) = results(tmp_path, [row("truth-on-voxels", 1.0, family=REFERENCE), row("fbp", 0.5)])
    assert names(case.best(SSIM)) == ["fbp"]
    first, second = case_table(case).rows
    assert first[0].text == "reference: truth-on-voxels"
    assert not any(cell.best for cell in first)
    assert (first[-2].text, first[-1].text) == ("–", "–")  # its time and size mean nothing
    assert all(cell.best for cell in second[1:])


def test_means_and_spreads_are_over_seeds(tmp_path):
    rows = [row("fbp", quality, seed=seed) for seed, quality in ((1, 0.80), (2, 0.84), (3, 0.88))]
    (case,) = results(tmp_path, rows)
    method = case.method("fbp")
    assert method.mean(SSIM) == pytest.approx(0.84)
    assert method.text(SSIM) == "0.840 ± 0.040"
    assert method.text(MEAN) == "−3.0 ± 2.0 %"
    assert method.text(SECONDS) == "8.40 ± 0.40"
    assert method.text(BYTES) == "20.0"
    assert case.seeds == [1, 2, 3]


def test_a_mean_over_fewer_scenes_does_not_win(tmp_path):
    rows = [row("gaussians", 0.8, seed=1), row("gaussians", 0.8, seed=2), row("fbp", 0.99, seed=1)]
    rows.append(failed("fbp", "no axis", seed=2))
    (case,) = results(tmp_path, rows)
    assert names(case.best(SSIM)) == ["gaussians"]
    assert "fbp (1 of 2 seeds)" in [r[0].text for r in case_table(case).rows]


def test_resolution_says_where_the_sampling_ends(tmp_path):
    limited = dict(row("fbp").volume, resolution_half=None)
    lost = dict(row("fbp").volume, resolution_half=math.inf)
    rows = [row("fbp", volume=limited), row("gaussians", 0.8), row("neural-field", volume=lost)]
    (case,) = results(tmp_path, rows)
    texts = {name: case.method(name).text(RESOLUTION) for name in ("fbp", "gaussians", "neural-field")}
    assert texts == {"fbp": "≤ 2.00", "gaussians": "5.00", "neural-field": "∞"}
    assert names(case.ranked(RESOLUTION)) == ["fbp", "gaussians", "neural-field"]


def test_infinite_and_missing_scores_are_shown_as_such(tmp_path):
    test = {"ssim": 1.0, "frcm": math.nan, "psnr": math.inf, "l1": 0.0}
    (case,) = results(tmp_path, [row("fbp", test=test, stored_bytes=None)])
    cells = dict(zip(case_table(case).head, case_table(case).rows[0]))
    assert cells["PSNR (dB)"].text == "∞"
    assert cells["FRCM"].text == "–"
    assert cells["stored (kB)"].text == "–"


# --- who is beaten ------------------------------------------------------------------------------------------


def test_every_method_ahead_of_ours_is_named_with_its_margin(tmp_path):
    rows = [row("gaussians", q, seed=s) for s, q in ((1, 0.90), (2, 0.90))]
    rows += [row("fbp", q, seed=s) for s, q in ((1, 0.97), (2, 0.89))]
    rows += [row("sirt-nonneg", q, seed=s) for s, q in ((1, 0.905), (2, 0.905))]
    rows += [row("neural-field", 0.5, seed=s) for s in (1, 2)]
    cases = results(tmp_path, rows)
    found = beaten(cases[0], SSIM)
    assert [(b.method, b.won, b.seeds) for b in found] == [("fbp", 1, 2), ("sirt-nonneg", 2, 2)]
    assert [b.margin for b in found] == pytest.approx([0.03, 0.005])
    assert [b.margin for b in beaten(cases[0], ERROR)] == pytest.approx([0.03, 0.005])
    table = beaten_table(cases)
    assert [r[1].text for r in table.rows] == ["SSIM", "FRCM", "Dice", "relative error of δ"]
    assert (
        table.rows[0][3].text == "fbp 0.930 (by 0.030, in 1 of 2 seeds); sirt-nonneg 0.905 (by 0.005, in 2 of 2 seeds)"
    )


def test_pairs_are_compared_on_their_common_scenes(tmp_path):
    rows = [
        row("gaussians", 0.9, seed=1),
        row("gaussians", 0.5, seed=2),
        row("fbp", 0.8, seed=1),
        failed("fbp", "x", 2),
    ]
    (case,) = results(tmp_path, rows)
    assert beaten(case, SSIM) == []  # although 0.8 is above ours' mean over both
    rows = [
        row("gaussians", 0.9, case="b", seed=1),
        row("fbp", 0.95, case="b", seed=1),
        row("fbp", 0.1, case="b", seed=2),
    ]
    (other, *_) = results(tmp_path, rows)
    assert [(b.method, b.seeds) for b in beaten(other, SSIM)] == [("fbp", 1)]


def test_the_verdict_counts_wins_and_defeats(tmp_path):
    rows = [row("gaussians", 0.9), row("fbp", 0.8), row("gaussians", 0.9, case="star"), row("fbp", 0.95, case="star")]
    cases = results(tmp_path, rows)
    assert "gaussians is best in SSIM in 1, FRCM in 1, Dice in 1, relative error of δ in 1" in verdict(cases)
    assert "in 4 of 8 comparisons" in verdict(cases)
    summary = {r[0].text: r[1] for r in summary_table(cases).rows}
    assert (summary["ball"].text, summary["ball"].best) == ("gaussians 0.900", True)
    assert (summary["star"].text, summary["star"].best) == ("fbp 0.950 (gaussians 0.900)", False)
    assert {r[0].text: r[1].text for r in wins_table(cases).rows} == {"gaussians": "1", "fbp": "1"}


def test_without_ours_there_is_still_a_verdict(tmp_path):
    cases = results(tmp_path, [row("fbp")])
    assert "none of these cases" in verdict(cases)
    assert beaten_table(cases) is None


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
    assert all(source.startswith("data:image/png;base64,") for source in checker.sources)
    assert base64.b64decode(checker.sources[0].split(",")[1])[:4] == b"\x89PNG"
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
