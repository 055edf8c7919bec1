"""Angles of frames: read from text files, and said of the views that come of them."""

from __future__ import annotations

import codecs
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..checks import InputError, finite, note, require, require_regular, warn
from ..tables import number_in, shown
from ..units import ANGLE_UNITS, unit_factor

if TYPE_CHECKING:
    from ..geometry import Views
    from ..scan import Scan

UNIT = re.compile(rf"(?<![a-z])({'|'.join(sorted(ANGLE_UNITS, key=len, reverse=True))})s?(?![a-z])", re.IGNORECASE)
NAME = re.compile(r"angle|theta|rotation|^rot\b|^deg", re.IGNORECASE)
"""Names of the column of angles, and of their part of a line of a log."""
FIELD = re.compile(r"\b(flat|dark)", re.IGNORECASE)
"""Words of a line of a log that is of no projection."""
WHOLE_TURNS = np.array([np.pi, 2 * np.pi])
CLOSE = 0.01
"""Angles that cover a half or a whole turn in radians to this part are radians in all likelihood."""
SAME_DEG = 1e-4
"""Views within so many degrees look from one side."""
FEW, NARROW = 8, 10.0
"""So many views within so many degrees are unusual."""
OFF_CENTRE = 0.1
"""Part of a frame's width by which the axis may be off its middle before matter is cut off that matters."""
ADVICE = "write one angle [degrees] a line, as 22.5"


def read_angles(path: Path) -> np.ndarray:
    """The angles [N] in degrees of a text file.

    It holds one a line, or all in one line, or a table with a header that names one column of angles, or lines of a log
    with `angle: NUMBER` in each; # begins a comment. A header or comment may say their unit. Errors: `InputError` for
    anything else, and for what looks like radians without saying so.
    """
    require_regular(path, "a text file of angles (--angles)")
    lines = [line.partition("#") for line in _text(path).splitlines()]
    rows = [row for row in (_cells(line) for line, *_ in lines) if row]
    said = " ".join(comment for *_, comment in lines)
    words, header = _angle_words(path, rows)
    require(len(words) > 0, f"{path} must hold the frames' angles in degrees, but it holds none.")
    values = finite(f"{path}: angles", np.array([_number(path, word) for word in words]))
    if unit := UNIT.search(f"{header} {said}".replace("_", " ")):
        return values * (unit_factor(f"{path}: angles", unit[1], ANGLE_UNITS) / ANGLE_UNITS["deg"])
    if len(values) >= FEW // 2:
        reach = np.ptp(values) * np.array([[1.0], [len(values) / (len(values) - 1)]])
        require(
            not (np.abs(reach / WHOLE_TURNS - 1) < CLOSE).any(),
            f"{path} must hold angles in degrees, but those from {values.min():.4g} to {values.max():.4g} look like "
            "radians; say which they are in a first line, '# radians' or '# degrees'.",
        )
    return values


def _text(path: Path) -> str:
    """The text of a file in UTF-8, or in UTF-16 with a mark."""
    try:
        content = path.read_bytes()
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return content.decode("utf-16" if wide else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--angles must be a text file of angles, but reading {path} failed: {error}.") from None


def _cells(line: str) -> list[str]:
    """The entries of a line: between commas, semicolons or tabs if there are any, else between spaces."""
    line = re.sub("[\"']", "", line).strip().strip("[]()").rstrip(",;").strip()
    if re.search(r"[,;\t]", line):
        return [cell.strip() for cell in re.split(r"[,;\t]", line)]
    return line.split() if _is_number(line.partition(" ")[0]) else [line] * bool(line)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _angle_words(path: Path, rows: list[list[str]]) -> tuple[list[str], str]:
    """The entries that are angles, as written, and what their header says of them."""
    if len(rows) == 1:
        return rows[0], ""
    header = [] if not rows or any(map(_is_number, rows[0])) else rows[0]
    body = rows[1:] if header else rows
    if len(header) == 1 and body and len(body[0]) > 1:
        header = header[0].split()
    projections = [row for row in body if not FIELD.search(" ".join(row))]
    labelled = [[re.split(r"[:=]", cell)[-1].strip() for cell in row if NAME.search(cell)] for row in projections]
    if labelled and all(len(found) == 1 for found in labelled):
        return [found[0] for found in labelled], " ".join(projections[0])
    if all(len(row) == 1 for row in body):
        return [row[0] for row in body], " ".join(header)
    named = [n for n, name in enumerate(header) if NAME.search(name)]
    if len(named) == 1 and all(len(row) == len(header) for row in body):
        return [row[named[0]] for row in body], header[named[0]]
    raise InputError(
        f"{path} must hold one angle a line, or a table with a header that names one column 'angle', but a line holds "
        f"{max(map(len, rows))} numbers; {ADVICE}, with a point before the decimals."
    )


def _number(path: Path, word: str) -> float:
    number = number_in(word)
    require(not math.isnan(number), f"{path} must hold angles in degrees, but it holds {shown(word)}; {ADVICE}.")
    return number


def angles_of(views: Views) -> np.ndarray | None:
    """The angles [N] in degrees of views that turn about the y axis; None for others."""
    rotations = views.rotations
    if not np.allclose(rotations[:, 1, 1], 1, atol=1e-6):
        return None
    return np.rad2deg(np.arctan2(rotations[:, 0, 2] - rotations[:, 2, 0], rotations[:, 0, 0] + rotations[:, 2, 2]))


def tell_angles(angles_deg: np.ndarray, source: str) -> None:
    """Say which range the angles [N] span, and where they are from."""
    note(f"{source}: {len(angles_deg)} angles from {angles_deg.min():.6g} to {angles_deg.max():.6g} degrees")


def tell_views(scan: Scan) -> None:
    """Warn of views whose angles or axis can hardly be meant: all from one side, a narrow fan, half of a turn's
    matter."""
    views, one = scan.views, scan.exposures.has_one_energy and len(np.unique(scan.exposures.distance)) == 1
    angles = angles_of(views)
    if angles is None or len(views) < 2 or not one or scan.is_series:
        return
    sides = np.sort(angles % 360)
    wide = 360 - float(np.diff([*sides, sides[0] + 360]).max())
    if wide < SAME_DEG:
        warn(f"all {len(views)} frames look from one side: their angles are all {angles[0]:.4g} degrees")
    elif wide < NARROW and len(views) >= FEW:
        warn(
            f"the angles of {len(views)} frames span {wide:.4g} degrees only; if they are radians, say so in their "
            "unit, or in the first line of the file of --angles"
        )
    width, shifts = views.shape[1], views.shifts[:, 0] / views.pixel_sizes
    off = float(shifts[0])
    if wide > 180 and np.allclose(shifts, off, atol=1e-3) and abs(off) > OFF_CENTRE * width:
        warn(
            f"the axis is at column {0.5 * (width - 1) - off:.4g} of {width}, far from the middle: a turn sweeps "
            f"{width + 2 * abs(off):.0f} pixels, but the volume is as wide as a frame, and matter beyond it is cut "
            "off; stitch opposite frames to wider ones first"
        )
