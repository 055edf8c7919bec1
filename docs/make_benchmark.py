"""The benchmark's pages, after `holosplat bench run --out bench` and `report`: `python docs/make_benchmark.py bench`.

Writes docs/benchmark_tables.md (the report's Markdown with the pictures of a few cases), docs/images/benchmark/,
docs/data/benchmark.csv (a line for each row), and tables of means over seeds in docs/overview.md and docs/benchmark.md.
`python docs/make_benchmark.py bench FILE.csv` writes the rows of a benchmark into that file, and nothing else.
"""

from __future__ import annotations

import csv
import re
import sys
from collections import defaultdict
from pathlib import Path

from PIL import Image

from holosplat.bench.case import case_names
from holosplat.bench.folder import BenchFolder
from holosplat.bench.rows import Row, read_row

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
    "surfaces": "surfaces, from Gaussians",
}
"""What docs/overview.md shows: cases, numbers, and methods as it calls them."""
OURS = ("gaussians", "surfaces")
STANDING = {"ssim": 1, "frcm": 1, "dice": 1, "relative_error_delta": -1}
"""The scores in which methods are compared, and whether more of it is better."""
SCORES = ("ssim", "frcm", "psnr", "l1")
VOLUME = ("dice", "relative_error_delta", "relative_error_beta", "delta_deviation", "ratio", "resolution_half")


def main(bench: Path) -> None:
    """Everything that the docs show of a benchmark."""
    folder = BenchFolder(bench)
    folder.require_bench()
    rows = [read_row(path) for path in sorted(folder.rows.glob("*.json"))]
    write_table(rows, DOCS / "data" / "benchmark.csv")
    write_page(folder, DOCS / "benchmark_tables.md")
    means = means_of(rows)
    fill(DOCS / "overview.md", overview(means))
    fill(DOCS / "benchmark.md", standing(rows, means))


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


Means = dict[tuple[str, str], dict[str, float]]
"""(case, method) → numbers, means over the seeds that are done."""


def means_of(rows: list[Row]) -> Means:
    """Numbers of every method on every case, means over seeds."""
    found: dict[tuple[str, str], list[dict[str, float | None]]] = defaultdict(list)
    for row in rows:
        if row.done:
            extra = {"seconds": row.seconds, "stored": row.stored_bytes and row.stored_bytes / 1e6}
            found[row.case, row.method].append({**row.test, **row.volume, **extra})
    return {
        key: {
            name: sum(values) / len(values)
            for name in several[0]
            if len(values := [v for one in several if (v := one.get(name)) is not None]) == len(several)
        }
        for key, several in found.items()
    }


def overview(means: Means) -> str:
    """The table of the cases `OVERVIEW_CASES`."""
    cases = " / ".join(f"{case}" for case in OVERVIEW_CASES)
    lines = ["| method | SSIM | Dice | error of δ | time / s | stored / MB |", "| --- | --- | --- | --- | --- | --- |"]
    for method, label in OVERVIEW_METHODS.items():
        chosen = [means.get((case, method), {}) for case in OVERVIEW_CASES]
        cells = [" / ".join(_shown(numbers, name) for numbers in chosen) for name in OVERVIEW_NUMBERS]
        lines.append(f"| {' | '.join([label, *cells])} |")
    return "\n".join([f"*{cases}*", "", *lines])


def standing(rows: list[Row], means: Means) -> str:
    """Gaussians and surfaces beside the best other method on every case and score."""
    references = {row.method for row in rows if row.is_reference}
    lines = ["| case | SSIM | FRCM | Dice | error of δ | time / s |", "| --- " * 6 + "|"]
    won: dict[str, dict[str, int]] = {name: dict.fromkeys((*OURS, "either"), 0) for name in STANDING}
    cases = [case for case in case_names() if (case, "gaussians") in means]
    for case in cases:
        others = {m: n for (c, m), n in means.items() if c == case and not m.startswith(OURS) and m not in references}
        cells = [_compared(case, name, means, others, won[name]) for name in STANDING]
        times = " / ".join(_shown(means[case, m], "seconds") if (case, m) in means else "–" for m in OURS)
        lines.append(f"| {case} | {' | '.join(cells)} | {times} |")
    for method in (*OURS, "either"):
        counts = " | ".join(str(count[method]) for count in won.values())
        lines.append(f"| {method}: best on, of {len(cases)} | {counts} | |")
    return "\n".join(lines)


def _compared(case: str, name: str, means: Means, others: dict[str, dict[str, float]], won: dict[str, int]) -> str:
    """One cell: ours, bold where no other method is better, and the best other; `won` counts."""
    sign = STANDING[name]
    method, best = max(((m, n[name]) for m, n in others.items()), key=lambda item: sign * item[1])
    shown, ahead = [], False
    for mine in OURS:
        if (case, mine) not in means:  # surfaces of two materials
            shown.append("–")
            continue
        value = means[case, mine][name]
        as_good = sign * value >= sign * best
        won[mine] += as_good
        ahead |= as_good
        shown.append(f"**{value:.3f}**" if as_good else f"{value:.3f}")
    won["either"] += ahead
    return f"{' / '.join(shown)} ({best:.3f}{'' if ahead else ', *' + str(method) + '*'})"


def fill(path: Path, table: str) -> None:
    """Put a table into a page, between its marks."""
    text = path.read_text(encoding="utf-8")
    marked = re.compile(r"(<!-- made by make_benchmark.py -->\n).*?(<!-- end -->)", re.DOTALL)
    path.write_text(marked.sub(lambda m: f"{m[1]}{table}\n{m[2]}", text), encoding="utf-8")


def _shown(numbers: dict[str, float], name: str) -> str:
    """A number as the table has it; a dash where there is none."""
    if name not in numbers:
        return "–"
    return f"{numbers[name]:.{ {'seconds': 0, 'stored': 1}.get(name, 3) }f}"


if __name__ == "__main__":
    if len(sys.argv) > 2:
        write_table(
            [read_row(path) for path in sorted(BenchFolder(Path(sys.argv[1])).rows.glob("*.json"))], Path(sys.argv[2])
        )
    else:
        main(Path(sys.argv[1]))
