"""Whether scores are still those of the committed benchmark, row by row: for changes that should not change results.

holosplat bench run --cases cells8 noise12-2000 --methods gaussians surfaces --snapshots DIR --out bench
python benchmarks/same_scores.py bench                # compares with docs/data/benchmark.csv
python benchmarks/same_scores.py bench --out docs/data/redesign.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rows import read, write

from holosplat_bench.suite.folder import BenchFolder, read_row

COMMITTED = Path(__file__).parents[1] / "docs" / "data" / "benchmark.csv"
SCORES = ("ssim", "frcm", "dice", "relative_error_delta")


def compared(bench: Path, committed: Path = COMMITTED) -> list[dict[str, str | float]]:
    """For every row of `bench` that the table has too: its scores, and how much each differs from the table's."""
    table = {(row["case"], row["seed"], row["method"]): row for row in read(committed)}
    found = []
    for path in sorted(BenchFolder(bench).rows.glob("*.json")):
        row = read_row(path)
        old = table.get((row.case, str(row.seed), row.method))
        if old is None or not row.done or old["status"] != "done":
            continue
        scores = {name: float((row.test | row.volume)[name] or "nan") for name in SCORES}
        differences = {f"{name}_change": scores[name] - float(old[name]) for name in SCORES}
        about: dict[str, str | float] = {"case": row.case, "seed": row.seed, "method": row.method}
        found.append({**about, "commit": row.commit, "before": old["commit"], **scores, **differences})
    return found


def main(bench: Path, out: Path | None) -> None:
    """Print, and perhaps write, the comparison."""
    rows = compared(bench)
    for row in rows:
        changes = ", ".join(f"{name} {row[name]:.4f} ({row[f'{name}_change']:+.1e})" for name in SCORES)
        print(f"{row['case']:16} {row['seed']} {row['method']:12} {changes}")
    largest = max((abs(float(row[f"{name}_change"])) for row in rows for name in SCORES), default=float("nan"))
    print(f"{len(rows)} rows; the largest change is {largest:.1e}")
    if out is not None and rows:
        write([{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows], out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path, help="folder of holosplat bench run")
    parser.add_argument("--out", type=Path, help="CSV file to write")
    chosen = parser.parse_args()
    main(chosen.bench, chosen.out)
