"""Rows of a benchmark as the runner writes them, and a folder of their results."""

from __future__ import annotations

from holosplat_bench.suite.folder import BenchFolder, Row
from holosplat_bench.suite.pages.results import read_results

FAMILIES = {"fbp": "tomography", "sirt-nonneg": "tomography", "gaussians": "Gaussians", "neural-field": "neural"}


def row(method: str, quality: float = 0.9, *, case: str = "ball", seed: int = 101, **changes) -> Row:
    """A finished row whose scores all follow from `quality`."""
    values = {
        "family": FAMILIES.get(method, "others"),
        "place": list(FAMILIES).index(method) if method in FAMILIES else 9,
        "summary": f"{method} in a line",
        "status": "done",
        "reason": "",
        "scan_hash": "0123",
        "commit": "abc1234",
        "when": "2026-01-02T03:04:05+00:00",
        "seconds": 10 * quality,
        "stored_bytes": 20_000,
        "test": {"ssim": quality, "frcm": quality - 0.1, "psnr": 30 * quality, "l1": 0.01},
        "train": {"ssim": quality, "frcm": quality, "psnr": 30.0, "l1": 0.01},
        "volume": {
            "dice": quality,
            "relative_error_delta": 1 - quality,
            "delta_deviation": 0.5 * (quality - 0.9),
            "resolution_half": 4e-6 / quality,
            "pitch": 1e-6,
        },
        "versions": {"holosplat": "0", "torch": "2"},
        "machine": {"processor": "one"},
    }
    return Row(case=case, seed=seed, method=method, **(values | changes))


def failed(method: str, reason: str, seed: int = 101) -> Row:
    return row(method, seed=seed, status="failed", reason=reason, seconds=None, stored_bytes=None, test={}, volume={})


def make(path, rows: list[Row]) -> BenchFolder:
    folder = BenchFolder(path / "bench")
    folder.create()
    for one in rows:
        folder.write_row(one)
    return folder


def results(path, rows: list[Row]):
    return read_results(make(path, rows))
