"""Every table and figure of the documentation: what makes it, from what, and whether it is as its data are.

    make figures                          # all tables, and all figures that need no runs
    python docs/figures.py --list         # everything, and what needs hours of runs first, by which command
    python docs/figures.py --check        # only say which tables differ from docs/data
    python docs/figures.py hero demo      # the figure `hero`, from the run folder `demo`

Tables stand in the pages between `<!-- table: NAME -->` and `<!-- end -->`; their numbers come from docs/data.
"""

from __future__ import annotations

import argparse
import importlib
import re
from dataclasses import dataclass
from pathlib import Path

from tables import TABLES, matter

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

MARKED = re.compile(r"(<!-- table: ([\w-]+) -->\n)(?:(?!<!--).)*(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Figure:
    """Pictures below docs/images: the module of docs/pictures with its `main`, what it is given, what makes that."""

    pictures: tuple[str, ...]
    module: str
    given: tuple[str, ...] = ()
    before: str = ""
    takes: str = "seconds"


FIGURES = {
    "hero": Figure(("hero.png",), "hero", ("DEMO",), "holosplat demo --out DEMO", "two minutes"),
    "cells": Figure(
        ("cells.png",),
        "cells",
        ("FOLDER",),
        "holosplat grow --cells 16 --box 80e-6 34e-6 26e-6 --flow 0.058 --snapshots 50 --out FOLDER",
        "three minutes",
    ),
    "surfaces": Figure(
        ("surfaces.png",), "surfaces", ("RUN", "TRUTH"), "python benchmarks/surfaces.py --runs FOLDER", "an hour"
    ),
    "simulation": Figure(("simulation_imperfections.png", "simulation_series.png"), "simulation", takes="minutes"),
    "imaging-chain": Figure(
        ("imaging_chain/light.png", "imaging_chain/flat_fields.png", "imaging_chain/slices.png"),
        "imaging_chain",
        ("WORK",),
        takes="ten minutes",
    ),
    "motion": Figure(
        ("motion.webp", "motion_shapes.png"),
        "motion",
        ("RUN",),
        "holosplat track SCAN --material haemoglobin --out RUN, of a scan as benchmarks/motion.py simulates it",
        "an hour",
    ),
    "thesis": Figure(
        (
            "thesis_sampling.png",
            *(
                f"thesis_{s}_{n}.png"
                for s in ("short", "third", "full")
                for n in ("curves", "psnr", "lines", "geometry")
            ),
        ),
        "thesis",
    ),
    "compact": Figure(("compact.png",), "compact"),
    "droplets": Figure(("droplets.png",), "droplets"),
    "matter": Figure(
        tuple(f"matter/{kind}.png" for kind in matter.KINDS),
        "matter",
        takes="a minute",
    ),
    "benchmark-rows": Figure((), "benchmark_rows", ("BENCH", "FILE.csv"), "holosplat bench run --out BENCH", "hours"),
    "benchmark": Figure(
        tuple(
            f"benchmark/{name}.png"
            for name in ("overview", "main12-slices", "main12-holograms", "main12-cost", "cells8-slices", "cells8-cost")
        )
        + tuple(f"benchmark/{n}.png" for n in ("noise12-2000-slices", "two_materials8-slices", "resolution-curves")),
        "benchmark",
        ("BENCH",),
        "holosplat bench run --out BENCH --snapshots DIR --seeds 101 102, then holosplat bench report BENCH",
        "a day",
    ),
}
ELSEWHERE = {
    ("plan.png", "plan.csv"): "the command of docs/planning.md: two minutes",
    ("tweezers.png",): "python benchmarks/tweezers.py: minutes",
    ("espresso_flow.png",): "python benchmarks/espresso_flow.py DATA: four minutes",
    tuple(f"real_data/{n}.png" for n in ("tooth", "dome", "dome_frames", "hair", "whole", "whole_soft")): (
        "python benchmarks/real_data.py --data FOLDER: an hour"
    ),
    ("real_data/bed.png", "real_data/bed_light.png"): (
        "python benchmarks/packed_bed.py --data FOLDER --work FOLDER: an hour"
    ),
}
"""Pictures that other commands of the project write, and how long these take."""


def pages() -> list[Path]:
    """All pages that may hold tables."""
    return [ROOT / "README.md", ROOT / "SECURITY.md", *sorted(DOCS.rglob("*.md"))]


def filled(text: str) -> str:
    """A page with its tables made anew."""
    return MARKED.sub(lambda found: f"{found[1]}{TABLES[found[2]].make()}\n{found[3]}", text)


def changed() -> dict[Path, str]:
    """The pages whose tables differ from what the data say, and what they should be."""
    found = {}
    for path in pages():
        before = path.read_text(encoding="utf-8")
        if (after := filled(before)) != before:
            found[path] = after
    return found


def listing() -> list[str]:
    """A line for each table and figure."""
    where = {name: page.relative_to(ROOT) for page in pages() for _, name, _ in MARKED.findall(page.read_text("utf-8"))}
    lines = ["tables: `make figures` makes them from docs/data; the data by"]
    for name, table in TABLES.items():
        data = ", ".join(f"docs/data/{file}" for file in table.data)
        lines.append(f"  {name} ({where.get(name, 'nowhere')}), {data}: {table.command} ({table.takes})")
    lines.append("figures: python docs/figures.py NAME …")
    for name, figure in FIGURES.items():
        needs = f", after {figure.before}" if figure.before else ""
        lines.append(f"  {name} {' '.join(figure.given)}: {', '.join(figure.pictures)}{needs} ({figure.takes})")
    lines += [f"  {', '.join(pictures)}: {command}" for pictures, command in ELSEWHERE.items()]
    return lines


def main() -> None:
    """Make, list or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", nargs="?", choices=FIGURES, help="one figure (default: all tables)")
    parser.add_argument("given", nargs="*", help="what the figure needs, see --list")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if options.list:
        print(*listing(), sep="\n")
    elif options.figure:
        figure = FIGURES[options.figure]
        if len(options.given) != len(figure.given):
            parser.error(f"{options.figure} needs {' '.join(figure.given) or 'nothing'}; make it by: {figure.before}")
        importlib.import_module(f"pictures.{figure.module}").main(*map(Path, options.given))
    else:
        differing = changed()
        for path, text in differing.items():
            print(f"{path.relative_to(ROOT)}: {'differs from docs/data' if options.check else 'made anew'}")
            if not options.check:
                path.write_text(text, encoding="utf-8")
        if not options.check:
            print("figures need runs first; python docs/figures.py --list says which, and by which command")
        raise SystemExit(1 if options.check and differing else 0)


if __name__ == "__main__":
    main()
