"""The rows of a benchmark as one table: `python docs/figures.py benchmark-rows BENCH FILE.csv`."""

from __future__ import annotations

import csv
from pathlib import Path

from holosplat_bench.suite.folder import BenchFolder, Row, read_row

SCORES = ("ssim", "frcm", "psnr", "l1")
VOLUME = ("dice", "relative_error_delta", "relative_error_beta", "delta_deviation", "ratio", "resolution_half")


def main(bench: Path, path: Path) -> None:
    """Write a line for each row that the folder `bench` has."""
    write_table([read_row(row) for row in sorted(BenchFolder(bench).rows.glob("*.json"))], path)


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
