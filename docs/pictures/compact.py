"""The picture of export.md, "Compact", from docs/data/compact.csv: `python docs/figures.py compact`."""

from __future__ import annotations

import csv
from pathlib import Path

from matplotlib.figure import Figure

from holosplat.report.style import CYCLE, WIDTH, letter, new_figure, styled

DOCS = Path(__file__).resolve().parents[1]
KINDS = {"gaussians": "Gaussians", "surfaces": "surfaces"}
FILES = {
    "object": ("s", "none", "as it is"),
    "compact": ("o", "-", "compact"),
    "voxels of 1/1 px": ("^", ":", "voxels of a pixel"),
    "voxels of 1/2 px": ("v", "--", "voxels of half a pixel"),
}
SCORES = {"frcm": "1 − FRCM of held-out frames", "error_delta": "error of δ"}


@styled
def main() -> None:
    """Draw docs/images/compact.png: what is lost over the bytes of the file."""
    with (DOCS / "data" / "compact.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    figure: Figure = new_figure(WIDTH, 2.6)
    for index, (axes, (score, label)) in enumerate(zip(figure.subplots(1, 2), SCORES.items())):
        for colour, (kind, said) in zip(CYCLE, KINDS.items()):
            for start, (mark, line, what) in FILES.items():
                chosen = [row for row in rows if row["kind"] == kind and row["file"].startswith(start)]
                size = [float(row["bytes"]) / 1e6 for row in chosen]
                lost = [1 - float(row[score]) if score == "frcm" else float(row[score]) for row in chosen]
                axes.plot(size, lost, marker=mark, ls=line, ms=3.5, color=colour, label=f"{said}, {what}")
        axes.set(xlabel="size of the file (MB)", ylabel=label, xscale="log", yscale="log")
        letter(axes, index, "")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=6, loc="outside lower center", ncols=4)
    figure.savefig(DOCS / "images" / "compact.png", dpi=160, metadata={"Software": None})
