"""Tables and figures of the documentation: made from committed data, and as the data are."""

from __future__ import annotations

import csv
import importlib
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """docs/figures.py."""
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("figures")


def test_tables_are_as_their_data(figures):
    """Or `make figures` was forgotten."""
    assert [str(path.relative_to(ROOT)) for path in figures.changed()] == []


def test_new_rows_of_motion_appear_by_rule(figures, monkeypatch):
    """Of cases that the tables know, at the times that a table is of; each case of a forecast has its own table."""
    motion = importlib.import_module("tables.motion")
    rows = {name: motion.read(f"{name}.csv") for name in ("motion", "motion_ablation", "forecast")}
    monkeypatch.setattr(motion, "read", lambda name: rows[name.removesuffix(".csv")])
    like = next(row for row in rows["motion"] if (row["case"], row["first"]) == ("flow2-body", "0"))
    like |= {"least_dice": "0.891", "error": "0.351", "centre_um": "0.0291", "volume_spread": "0.0036"}
    like |= {"cpu_seconds": "258.2"}
    rows["forecast"] = [row for row in rows["forecast"] if row["case"] == "flow4"]
    rows["motion"] = [like | {"dice": "0.5"}, like | {"first": "99", "dice": "0.6"}, like | {"times": "24"}]
    assert motion.tracked().splitlines()[2:] == [
        "| 2 at 0°, 90°, `--body red-cell` | 0.500 (0.891) | 0.35 | 14 of 14 | 16 of 16 | 0.029 µm | ± 0.36 % | 258 s |"
    ]
    rows["motion"] = [like | {"case": "flow4", "first": "7", "every": "3"}]
    assert [line.split(" | ")[0] for line in motion.windows().splitlines()[2:]] == ["| 20 … 35", "| 7, 10 … 52"]
    before = motion.forecast()
    kept = [row for row in rows["forecast"] if row["model"] in ("paths", "dynamics")]
    rows["forecast"] = [row | {"case": "flow2-body"} for row in kept[1:]] + rows["forecast"]
    first, _, rest = motion.forecast().partition("\n\n")
    assert first == before
    assert rest.startswith("*2 at 0°, 90°, `--body red-cell`*\n\n| times ahead | paths | dynamics | SSIM of paths |")
    assert re.fullmatch(r"\| 1 \| 0\.044 / 0\.0\d\d \| – \| 0\.998 \|", rest.splitlines()[4])


def test_a_number_that_drifts_is_seen(figures):
    page = (DOCS / "notebook" / "verdict.md").read_text(encoding="utf-8")
    assert figures.filled(page) == page
    assert figures.filled(page.replace("| 3012937 |", "| 3012936 |")) == page
    assert page.count("| 3012937 |") == 1


def test_an_empty_table_takes_nothing_with_it(figures):
    page = "<!-- table: verdicts -->\n<!-- end -->\nText.\n<!-- table: round-cell -->\n|\n<!-- end -->\n"
    parts = figures.filled(page).split("<!-- end -->\n")
    assert parts[0].startswith("<!-- table: verdicts -->\n| mistake | result")
    assert parts[1].startswith("Text.\n<!-- table: round-cell -->\n| | δ/β told")
    assert len(parts) == 3


TABLE = re.compile(r"^\|.*\n\| ---.*\n((?:\|.*\n)+)", re.MULTILINE)
DECLARED = {
    "docs/simulation.md": "| option | views |",
    "docs/notebook/thesis_study.md": "| the thesis | here |",
    "docs/motion.md": "| prior | option |",
    "docs/notebook/motion.md": "| prior | option |",
}
"""Tables of settings, which nobody measured."""
WHOLE = "docs/notebook/benchmark_tables.md"
"""The page that docs/pictures/benchmark.py writes from docs/data as a whole."""


def test_numbers_that_were_measured_stand_in_tables_that_a_script_makes(figures):
    """Tables of which a quarter of the cells have decimals or units, outside of marks."""
    assert "benchmark_tables.md" in (DOCS / "pictures/benchmark.py").read_text("utf-8")
    found = []
    for page in figures.pages():
        name = page.relative_to(ROOT).as_posix()
        for table in TABLE.finditer(figures.MARKED.sub("", page.read_text("utf-8"))):
            cells = [cell for line in table[1].splitlines() for cell in line.strip("|").split("|")[1:]]
            numbers = [cell for cell in cells if re.search(r"\d\.\d|\d (%|s|ms|kB|MB|GB)\b", cell)]
            declared = table[0].startswith(DECLARED.get(name, "none"))
            if len(numbers) > len(cells) / 4 and name != WHOLE and not declared:
                found.append(f"{name}: {table[0].splitlines()[0]}")
    assert found == []


def test_every_table_stands_in_a_page_and_has_its_data(figures):
    found = [name for page in figures.pages() for _, name, _ in figures.MARKED.findall(page.read_text("utf-8"))]
    assert sorted(found) == sorted(figures.TABLES)
    missing = [file for table in figures.TABLES.values() for file in table.data if not (DOCS / "data" / file).exists()]
    assert missing == []


def test_every_picture_is_made_by_something_and_there(figures):
    """And each script that draws has a `main`."""
    made = {name for figure in figures.FIGURES.values() for name in figure.pictures}
    made |= {name for names in figures.ELSEWHERE for name in names}
    images = DOCS / "images"
    there = {path.relative_to(images).as_posix() for path in images.rglob("*.*")}
    assert made == there, "docs/figures.py must name every picture, in FIGURES or ELSEWHERE"
    assert all("def main(" in (DOCS / f"pictures/{f.module}.py").read_text("utf-8") for f in figures.FIGURES.values())


def test_every_data_file_is_named(figures):
    """By a page, a script or a test, or by the table that it makes."""
    scripts = [path for room in ("src", "benchmarks", "tests") for path in (ROOT / room).rglob("*.py")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in [*figures.pages(), *scripts])
    named = {name.split("/")[0] for name in re.findall(r"\bdata/([\w./-]+\w)", text)}
    named |= {file.split("/")[0] for table in figures.TABLES.values() for file in table.data}
    assert sorted(p.name for p in (DOCS / "data").iterdir() if p.name not in named) == []


def test_what_is_listed(figures):
    text = "\n".join(figures.listing())
    assert "nowhere" not in text
    assert "standing (docs/notebook/benchmark.md), docs/data/benchmark.csv: holosplat bench run" in text
    assert "cells FOLDER: cells.png, after holosplat grow" in text


# --- the plan of the code -----------------------------------------------------------------------------------


def shown_rooms(package: str) -> set[str]:
    """What the tree in docs/design/architecture.md shows of a package in src."""
    text = (DOCS / "design" / "architecture.md").read_text(encoding="utf-8")
    tree = re.split(r"^\S", text.split(f"src/{package}/")[1], flags=re.MULTILINE)[0]
    lines = [line for line in tree.splitlines() if re.match(r"  \S", line)]
    inside = [line for line in tree.splitlines() if re.match(r"    \S", line)]
    names = re.compile(r"\b([a-z_]+(?:\.py|\.toml|/))(?=\s|$)")
    top = {name for line in lines for name in names.findall(line)}
    return top | {f"projectors/{name}" for line in inside for name in names.findall(line)[:1]}


@pytest.mark.parametrize("package", [ROOT / "src" / "holosplat", ROOT / "src" / "holosplat_bench"])
def test_the_plan_shows_the_rooms_that_are_there(package):
    there = {f"{p.name}/" for p in package.iterdir() if p.is_dir() and p.name != "__pycache__"}
    there |= {p.name for p in package.iterdir() if p.suffix in (".py", ".toml") and p.name != "__init__.py"}
    there |= {f"projectors/{path.parent.name}/" for path in package.glob("projectors/*/__init__.py")}
    assert shown_rooms(package.name) == there


def test_runs_of_a_seed_that_differ_by_a_scan_s_rounding_begin_alike():
    """Frames of one scene have another hash on another processor; the first look tells whether more differs."""
    with (DOCS / "data" / "thesis_study" / "runs.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if re.fullmatch(r"8k-v\d", row["name"])]
    firsts = dict[tuple[str, ...], dict[str, list[float]]]()
    for row in rows:
        study = [row[key] for key in ("schedule", "case", "physics", "seed", "name")]
        curves = (DOCS / "data" / "thesis_study" / f"{'_'.join(study)}.csv").read_text().splitlines()
        look = dict(zip(curves[0].split(","), map(float, curves[1].split(","))))
        scores = [look[name] for name in ("test_ssim", "test_frcm", "train_ssim", "train_frcm")]
        firsts.setdefault(tuple(study[1:4]), {})[row["scan_hash"]] = scores
    several = [hashes.values() for hashes in firsts.values() if len(hashes) > 1]
    assert several
    for looks in several:
        first, *others = looks
        assert all(other == pytest.approx(first, abs=1e-5) for other in others)
