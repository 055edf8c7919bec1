"""The pictures of motion.md, of a run of track: `python docs/figures.py motion RUN`. Those that stand there are of four
beams as benchmarks/motion.py simulates them (128 × 96 pixels)."""

from __future__ import annotations

from pathlib import Path

import holosplat as hs
from holosplat.io.formats import read_as, run_reading
from holosplat.report.moving_figures import animation, shapes_figure
from holosplat.report.run import moving_of
from holosplat.workflows.track import read_errors

IMAGES = Path(__file__).parents[1] / "images"


def main(path: Path) -> None:
    """Draw docs/images/motion.webp and motion_shapes.png from the run folder `path`."""
    folder = hs.RunFolder(path)
    scan = read_as(folder.source_scan(), run_reading(path)).in_memory()
    moving = moving_of(hs.load_reconstruction(folder), scan, None, read_errors(folder))
    picture = animation(moving)
    assert picture is not None, "Pillow has no WebP here"
    (IMAGES / "motion.webp").write_bytes(picture)
    shapes_figure(moving).savefig(IMAGES / "motion_shapes.png", dpi=130)
