"""The benchmark's pages, after `holosplat bench run --out bench` and `bench report`: `docs/figures.py benchmark bench`.

Writes docs/notebook/benchmark_tables.md (the report's Markdown with pictures of a few cases), docs/images/benchmark/,
docs/data/benchmark.csv (a line for each row), and the tables of the pages that come from it (docs/figures.py).
`docs/figures.py benchmark-rows bench FILE.csv` writes the rows of a benchmark into that file, and nothing else.
"""

from __future__ import annotations

import re
from pathlib import Path

from figures import changed

from holosplat_bench.suite.folder import BenchFolder

from .benchmark_rows import main as rows_of
from .drawing import in_few_colours

DOCS = Path(__file__).parents[1]
PICTURES = {
    "overview",
    *(f"{case}-slices" for case in ("main12", "cells8", "noise12-2000", "two_materials8")),
    *("main12-holograms", "main12-cost", "cells8-cost", "resolution-curves"),
}
"""Which of the report's pictures the repository keeps."""
WIDTH, COLOURS = 1100, 128


def main(bench: Path) -> None:
    """Everything that the docs show of a benchmark."""
    folder = BenchFolder(bench)
    folder.require_bench()
    rows_of(bench, DOCS / "data" / "benchmark.csv")
    write_page(folder, DOCS / "notebook" / "benchmark_tables.md")
    for page, text in changed().items():
        page.write_text(text, encoding="utf-8")


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
