"""A method of the benchmark: options of the library's own methods, with a name and a heading for the tables."""

from __future__ import annotations

from dataclasses import dataclass

from holosplat.matter import MaterialPrior
from holosplat.methods import Method as Options
from holosplat.progress import Progress
from holosplat.scan import Scan
from holosplat.volume import Object
from holosplat.workflows.reconstruct import reconstruct

from .aligners import Aligner


@dataclass(frozen=True)
class Method:
    """name: for the command line and the table; family: its heading in the table; summary: one line of what it does;
    options: of the library's method that runs; aligner: what first finds where the beams are (None: nothing)."""

    name: str
    family: str
    summary: str
    options: Options
    aligner: Aligner | None = None

    def run(self, scan: Scan, prior: MaterialPrior, seed: int, on_progress: Progress) -> Object:
        """The Object that the method makes of the training frames `scan`; `InputError` where it cannot."""
        if self.aligner is not None:
            scan = self.aligner(scan, prior, on_progress)
        return reconstruct(
            scan, prior, self.options, seed, on_progress=lambda stage, part, record: on_progress(stage, part)
        ).object
