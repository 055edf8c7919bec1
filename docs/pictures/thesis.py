"""The pictures of notebook/thesis_study.md, from docs/data/thesis_study: `python docs/figures.py thesis`."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from tables.benchmark import read
from tables.thesis import SCHEDULES, read_rows, studies

from holosplat.report.style import CYCLE, FAINT, WIDTH, letter, new_figure, styled
from holosplat_bench.suite.pages.page import save
from holosplat_bench.thesis.pages.page import pictures

IMAGES = Path(__file__).resolve().parents[1] / "images"
CELL_PX = 7.8
"""Width of a cell of the case [pixels]."""


@styled
def sampling_figure() -> Figure:
    """Errors of frames over wave samples a pixel, and what views resolve over their number, from sampling.csv."""
    found = read("thesis_study/sampling.csv")
    figure = new_figure(0.8 * WIDTH, 2.2)
    left, right = figure.subplots(1, 2)
    for index, (physics, said) in enumerate((("declared", "10 cm"), ("far", "50 cm"))):
        chosen = [row for row in found if row["of"] == physics]
        counts, values = ([float(row[key]) for row in chosen] for key in ("count", "value"))
        left.plot(counts, values, "o-", ms=3, color=CYCLE[index], label=said)
    left.set(xlabel="wave samples a pixel", ylabel="error / contrast", xscale="log", yscale="log")
    left.set_xticks([1, 2, 4, 8], ["1", "2", "4", "8"], minor=False)
    left.minorticks_off()
    left.legend()
    letter(left, 0, "Supersampling")
    chosen = [row for row in found if row["what"] == "angle"]
    counts, values = ([float(row[key]) for row in chosen] for key in ("count", "value"))
    right.plot(counts, values, "o-", ms=3, color=CYCLE[0])
    right.axhline(CELL_PX, color=FAINT, ls="--", lw=0.8)
    right.set(xlabel="views over 180°", ylabel="resolved length (pixels)", ylim=(0, None))
    letter(right, 1, "Angular sampling")
    return figure


def main() -> None:
    """Draw all of them that the data have."""
    save(sampling_figure(), IMAGES / "thesis_sampling.png")
    rows = read_rows()
    for schedule, said in SCHEDULES.items():
        study = studies(rows).get(f"{said}, 0")
        for picture in pictures(study) if study else ():
            name = picture.file.replace("thesis_", f"thesis_{schedule}_")
            assert study is not None
            save(picture.draw(study), IMAGES / name)
