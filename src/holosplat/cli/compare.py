"""`holosplat compare`: two runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..io.reading import Told
from .places import Output

if TYPE_CHECKING:
    from ..report.compare import Side


def compare(
    a: Positional[Path], b: Positional[Path], out: Output = Path("compare.html"), allow_external: bool = False
) -> None:
    """Compare two runs side by side: what was asked, decided and found, and where their volumes differ.

    Of runs of matter in motion, the first times are compared.

    Args:
        a: Run folder.
        b: Another one.
        out: Page to write (HTML), with slices of both volumes and their difference.
        allow_external: Follow links of the runs' scans to other files; only of files you trust.
    """
    from ..report.compare import Comparison, in_columns, write_comparison

    for path in (a, b):
        Told(allow_external=allow_external).vouch(path)
    comparison = Comparison(_side(a), _side(b))
    for table in (*comparison.found(), *comparison.asked()):
        print("\n".join(in_columns(table)))
    print(comparison.verdict())
    write_comparison(comparison, out)
    print(f"page: {out}")


def _side(path: Path) -> Side:
    """A run with its scores, as far as its scan is still there."""
    from ..io.json import read_json
    from ..io.reading import Part, Reading
    from ..report.compare import side_of
    from ..workflows.reconstruction import instants_of
    from ..workflows.run_folder import RunFolder
    from .scans import scan_for

    folder, scan = RunFolder(path), None
    folder.require_run()
    told = read_json(folder.source).get("scan") if folder.source.is_file() else None
    if told and Path(str(told)).exists():
        scan = scan_for(folder, None, Reading(part=Part(time_frame=0)) if instants_of(folder) else Reading())
    return side_of(folder, scan)
