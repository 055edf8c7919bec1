"""The benchmark's pages, after `holosplat bench run --out bench` and `report`: `python docs/make_benchmark.py bench`.

Writes docs/notebook/benchmark_tables.md (the report's Markdown with pictures of a few cases), docs/images/benchmark/,
docs/data/benchmark.csv (a line for each row), and the tables of the pages that come from it (docs/figures.py).
`python docs/make_benchmark.py bench FILE.csv` writes the rows of a benchmark into that file, and nothing else.
"""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

from drawing import in_few_colours
from figures import changed

from holosplat_bench.suite.folder import BenchFolder
from holosplat_bench.suite.rows import Row, read_row

DOCS = Path(__file__).parent
PICTURES = {
    "overview",
    *(f"{case}-slices" for case in ("main12", "cells8", "noise12-2000", "two_materials8")),
    *("main12-holograms", "main12-cost", "cells8-cost", "resolution-curves"),
}
"""Which of the report's pictures the repository keeps."""
WIDTH, COLOURS = 1100, 128
SCORES = ("ssim", "frcm", "psnr", "l1")
VOLUME = ("dice", "relative_error_delta", "relative_error_beta", "delta_deviation", "ratio", "resolution_half")


def main(bench: Path) -> None:
    """Everything that the docs show of a benchmark."""
    folder = BenchFolder(bench)
    folder.require_bench()
    rows = [read_row(path) for path in sorted(folder.rows.glob("*.json"))]
    write_table(rows, DOCS / "data" / "benchmark.csv")
    write_page(folder, DOCS / "notebook" / "benchmark_tables.md")
    for page, text in changed().items():
        page.write_text(text, encoding="utf-8")


def write_table(rows: list[Row], path: Path) -> None:
    """One line for each row: what it is, and its numbers."""
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ("case", "seed", "method", "status", "reason", "commit", "seconds", "stored_bytes", *SCORES, *VOLUME)
        )
        for row in rows:
            known = (row.case, row.seed, row.method, row.status, row.reason, row.commit, row.seconds, row.stored_bytes)
            numbers = [row.test.get(name) for name in SCORES] + [row.volume.get(name) for name in VOLUME]
            writer.writerow(f"{v:.6g}" if isinstance(v, float) else v for v in (*known, *numbers))


def write_page(folder: BenchFolder, path: Path) -> None:
    """The report's Markdown, with the chosen pictures in few colours and without the others."""
    images = DOCS / "images" / "benchmark"
    images.mkdir(parents=True, exist_ok=True)
    blocks = re.split(r"\n\n", folder.markdown.read_text(encoding="utf-8"))
    kept: list[str] = []
    skipping = False
    for block in blocks:
        picture = re.match(r"!\[[^\]]*\]\(report/(.+)\.png\)", block)
        if picture:
            skipping = picture[1] not in PICTURES
            if not skipping:
                in_few_colours(folder.images / f"{picture[1]}.png", images / f"{picture[1]}.png", COLOURS, WIDTH)
                block = block.replace("(report/", "(../images/benchmark/")
        elif block.startswith("**Figure"):
            if skipping:
                continue
            block = re.sub(r"^\*\*Figure \d+ \| ", "**", block)
        if not (picture and skipping):
            kept.append(re.sub(r"system [^,|]*, ", "", block))
    path.write_text("\n\n".join(kept), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        write_table(
            [read_row(path) for path in sorted(BenchFolder(Path(sys.argv[1])).rows.glob("*.json"))], Path(sys.argv[2])
        )
    else:
        main(Path(sys.argv[1]))
