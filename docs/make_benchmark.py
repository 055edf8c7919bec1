"""The benchmark's pages, after `holosplat bench run --out bench` and `report`: `python docs/make_benchmark.py bench`.

Writes docs/benchmark_tables.md (the report's Markdown with the pictures of a few cases), docs/images/benchmark/,
docs/data/benchmark.csv (a line for each row), and the numbers of the suite in docs/overview.md.
"""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

from PIL import Image

from holosplat.experiments.bench.folder import BenchFolder
from holosplat.experiments.bench.rows import Row, read_row

DOCS = Path(__file__).parent
PICTURES = {
    "overview",
    *(f"{case}-slices" for case in ("main12", "cells8", "noise12-2000", "two_materials8")),
    *("main12-holograms", "main12-cost", "cells8-cost", "resolution-curves"),
}
"""Which of the report's pictures the repository keeps."""
WIDTH, COLOURS = 1100, 128
OVERVIEW_CASES = ("main12", "cells8")
OVERVIEW_NUMBERS = ("ssim", "dice", "relative_error_delta", "seconds", "stored")
OVERVIEW_METHODS = {
    "paganin-fbp": "Paganin, FBP",
    "paganin-sirt-nonneg": "Paganin, SIRT ≥ 0",
    "paganin-svmbir": "Paganin, svmbir",
    "paganin-tv": "Paganin, TV in the box",
    "tikhonov-tv": "nonlinear Tikhonov, TV in the box",
    "holographic-tv": "holographic TV",
    "voxels-waves": "voxels through the waves",
    "neural-field": "neural field",
    "gaussians-random": "Gaussians, random start",
    "gaussians": "Gaussians",
}
"""What docs/overview.md shows: cases, numbers, and methods as it calls them."""
SCORES = ("ssim", "frcm", "psnr", "l1")
VOLUME = ("dice", "relative_error_delta", "delta_deviation", "ratio", "resolution_half")


def main(bench: Path) -> None:
    """Everything that the docs show of a benchmark."""
    folder = BenchFolder(bench)
    folder.require_bench()
    rows = [read_row(path) for path in sorted(folder.rows.glob("*.json"))]
    write_table(rows, DOCS / "data" / "benchmark.csv")
    write_page(folder, DOCS / "benchmark_tables.md")
    fill(DOCS / "overview.md", rows)


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
                shrink(folder.images / f"{picture[1]}.png", images / f"{picture[1]}.png")
                block = block.replace("(report/", "(images/benchmark/")
        elif block.startswith("**Figure"):
            if skipping:
                continue
            block = re.sub(r"^\*\*Figure \d+ \| ", "**", block)
        if not (picture and skipping):
            kept.append(re.sub(r"system [^,|]*, ", "", block))
    path.write_text("\n\n".join(kept), encoding="utf-8")


def shrink(source: Path, target: Path) -> None:
    """The picture at most `WIDTH` pixels wide, in `COLOURS` colours."""
    image = Image.open(source).convert("RGB")
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


def fill(path: Path, rows: list[Row]) -> None:
    """Put the table of the two cases `OVERVIEW_CASES` into a page, between its marks."""
    found = {(row.case, row.method): row for row in rows if row.done}
    cases = " / ".join(f"{case}" for case in OVERVIEW_CASES)
    lines = ["| method | SSIM | Dice | error of δ | time / s | stored / MB |", "| --- | --- | --- | --- | --- | --- |"]
    for method, label in OVERVIEW_METHODS.items():
        chosen = [found.get((case, method)) for case in OVERVIEW_CASES]
        cells = [" / ".join(_shown(row, name) for row in chosen) for name in OVERVIEW_NUMBERS]
        lines.append(f"| {' | '.join([label, *cells])} |")
    table = "\n".join([f"*{cases}*", "", *lines])
    text = path.read_text(encoding="utf-8")
    marked = re.compile(r"(<!-- made by make_benchmark.py -->\n).*?(<!-- end -->)", re.DOTALL)
    path.write_text(marked.sub(lambda m: f"{m[1]}{table}\n{m[2]}", text), encoding="utf-8")


def _shown(row: Row | None, name: str) -> str:
    """A number of a row as the table has it; a dash where there is none."""
    values = {} if row is None else {**row.test, **row.volume, "seconds": row.seconds, "stored": row.stored_bytes}
    value = values.get(name)
    if value is None:
        return "–"
    return {"seconds": f"{value:.0f}", "stored": f"{value / 1e6:.1f}"}.get(name, f"{value:.3f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
