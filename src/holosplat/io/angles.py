"""The order of frames in numbered files, their angles in text files, and warnings of odd angles."""

from __future__ import annotations

import codecs
import math
import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..checks import InputError, finite, note, require, require_regular, warn
from ..tables import number_in, shown
from ..units import ANGLE_UNITS, unit_factor
from .guard import mapped_array

if TYPE_CHECKING:
    from ..geometry import Views
    from ..scan import Scan

NUMBER = re.compile(r"\d+(?:\.\d+)*")
HEXADECIMAL = re.compile("[0-9a-f]{1,16}")
DATE = re.compile(r"(?<!\d)((?:19|20)\d\d)([-_.]?)(0[1-9]|1[0-2])\2([0-2]\d|3[01])(?!\d)")
"""A date from the year to the day, which `_dated` makes one number with the time after it."""
CLOCK = re.compile(r"(?<=#)(\d{8})[-_t .]*([01]\d|2[0-3])([-_.:h]?)([0-5]\d)\3([0-5]\d)(?!\d)")
SIGNS = str.maketrans({"\N{MINUS SIGN}": "-", "m": "-", "p": "+"})
NAMED = 4
"""Kinds of names that a warning names at most."""
Words = tuple[str, ...]
Numbers = tuple[Decimal, ...]


def in_order(files: Sequence[Path]) -> list[Path]:
    """The files in the order of the running number in their names, which may have a sign, decimals or an exponent.

    Of several numbers that run differently, the running one counts the files in steps of one, or is the only whole
    number that no two files share. A date and the time after it are one number. Names without such a number are sorted
    by their words and numbers from left to right, with a warning where they may be those of several series. Errors:
    `InputError` where two numbers could be the running one or numbers may be hexadecimal, and for two files with equal
    numbers.
    """
    files = sorted(files)
    names = [file.stem.lower() for file in files]
    split = _split([_dated(name) for name in names])
    in_turn = [[part for pair in zip(words, (*numbers, Decimal(0))) for part in pair] for words, numbers in split]
    order = sorted(range(len(files)), key=in_turn.__getitem__)
    for one, other in pairwise(order):
        if split[one] == split[other]:
            raise InputError(
                f"{files[0].parent} must say by its files' names in which order the frames were taken, but "
                f"{files[one].name} and {files[other].name} have the same number; take one of them out, or choose the "
                "frames' names by --files."
            )
    if len({words for words, _ in split}) > 1:
        _require_decimal(files, names, order)
        counts = Counter(split[i][0] for i in order)
        if len(counts) < len(files):  # some are numbered: they may be of several series, copies, or none of the frames
            firsts = {split[i][0]: files[i].name for i in reversed(order)}
            named = ", ".join(f"{count} as {firsts[kind]}" for kind, count in [*counts.items()][:NAMED])
            more = f" and others of {len(counts) - NAMED} kinds" if len(counts) > NAMED else ""
            warn(
                f"{files[0].parent} has files of different names, {named}{more}; they are taken for one series in this "
                "order. If they are not, choose the frames' names by --files, or take the others out"
            )
        return [files[i] for i in order]
    columns = [column for column in zip(*(numbers for _, numbers in split)) if len(set(column)) > 1]
    counting = [column for column in columns if len(set(column)) == len(column)]
    orders = {tuple(sorted(range(len(files)), key=column.__getitem__)): column for column in counting}
    if counting and counting[0] is not columns[0]:  # what comes before it may count more: a day before a time
        orders.setdefault(tuple(order), columns[0])
    if len(orders) > 1:
        whole = {order: column for order, column in orders.items() if all(n == int(n) for n in column)}
        running = {order: column for order, column in whole.items() if max(column) - min(column) == len(files) - 1}
        orders = running or (whole if columns[0] in counting else orders)
    if len(orders) == 1:
        return [files[i] for i in next(iter(orders))]
    if counting:
        raise InputError(
            f"{files[0].parent} must say by its files' names in which order the frames were taken, but several numbers "
            f"in {files[0].name} and the others run differently; leave one number in the names."
        )
    return [files[i] for i in order]


def _dated(name: str) -> str:
    """A name with its date, and the time of the day after it, as one number."""
    return CLOCK.sub(r"\1\2\4\5", DATE.sub(r"#\1\3\4", name))


def _require_decimal(files: Sequence[Path], names: Sequence[str], order: Sequence[int]) -> None:
    """`InputError` for names whose numbers may be hexadecimal, and would then have another order."""
    start, end = _shared(names), _shared([name[::-1] for name in names])
    ends = [name[start : len(name) - end] for name in names]
    if not all(map(HEXADECIMAL.fullmatch, ends)) or not any(end[0].isdigit() for end in ends):
        return
    values = [int(end, 16) for end in ends]
    require(
        sorted(range(len(files)), key=values.__getitem__) == list(order),
        f"{files[0].parent} must say by its files' names in which order the frames were taken, but numbers such as "
        f"that in {files[order[-1]].name} may be hexadecimal; write them with decimal digits.",
    )


def _shared(names: Sequence[str]) -> int:
    """The number of characters with which all names begin."""
    return next((n for n, letters in enumerate(zip(*names)) if len(set(letters)) > 1), min(map(len, names)))


def _split(names: Sequence[str]) -> list[tuple[Words, Numbers]]:
    """The words of names between their numbers, and the numbers.

    `1.10` beside `1.9` is two numbers, as in versions; elsewhere a point within a number is that of decimals. A minus
    or plus is a sign where it does not join a word with the number, or where some of the names lack it; so are the
    letters m and p (m10, p10) where that makes the words of all names the same.
    """
    found = [NUMBER.findall(name) for name in names]
    fractions = [text.partition(".")[2] for texts in found for text in texts if "." in text]
    decimal = not any("." in text for text in fractions) and (
        len({len(text) for text in fractions}) < 2
        or not any(len(text) > 1 and text.endswith("0") for text in fractions)
    )
    number = r"\d+(?:\.\d+)?(?:e[-+]\d+)?" if decimal else r"\d+"
    minus = "-+\N{MINUS SIGN}"
    ways = (rf"(?<![a-z0-9])[{minus}]{number}|{number}", rf"[{minus}]?{number}", rf"(?:(?<![a-z0-9])[mp])?{number}")

    def parted(name: str, number: str) -> tuple[Words, Numbers]:
        return tuple(re.split(number, name)), tuple(Decimal(text.translate(SIGNS)) for text in re.findall(number, name))

    split = [[parted(name, way) for name in names] for way in ways]
    return next((way for way in split if len({words for words, _ in way}) == 1), split[0])


UNIT = re.compile(rf"(?<![a-z])({'|'.join(sorted(ANGLE_UNITS, key=len, reverse=True))})s?(?![a-z])", re.IGNORECASE)
WITH_UNIT = re.compile(rf"([-+.\deE]*\d\.?)\s*({UNIT.pattern})", re.IGNORECASE)
BRACKETED = re.compile(r"[\[(]\s*([^\W\d]+)\s*(?:[\])]|$)")
"""A word of a header that stands where units do."""
NAME = re.compile(r"angle|theta|rotation|^rot(?![a-z])|^deg|^rad|^phi(?![a-z])|omega|winkel", re.IGNORECASE)
"""Names of the column of angles."""
LABELLED = re.compile(r"(?:angle|theta|rotation)\s*[:=]?\s*([-+]?\d[\d.]*(?:e[-+]?\d+)?)(.*)", re.IGNORECASE)
"""The angle in a line of a log, and what follows it."""
ORDER = re.compile(r"(image|frame|projection|file)?[ _]*(name|file|index|number|no|nr|id|n|i|#)?\.?", re.IGNORECASE)
"""Names of the column that says which frame a row is of."""
FIELD = re.compile(r"\b(flat|dark)", re.IGNORECASE)
"""Words of a line of a log that is of no projection."""
WHOLE_TURNS = np.array([np.pi, 2 * np.pi])
CLOSE = 0.01
"""Angles that cover a half or a whole turn in radians to this part are radians in all likelihood."""
SAME_DEG = 1e-4
"""Views within so many degrees look from one side."""
WHOLE_TURN = 360.0
FEW, NARROW = 8, 10.0
"""So many views within so many degrees are unusual."""
OFF_CENTRE = 0.1
"""Part of a frame's width by which the axis may be off its middle before matter is cut off that matters."""
LIST = re.compile(r"[^\[\]#\d]*\[([-+\d\s,;.eE]+)\][^\[\]#\d]*")
ADVICE = "write one angle [degrees] a line, as 22.5"


def read_angles(path: Path) -> np.ndarray:
    """The angles [N] in degrees of a text file, or of an array (.npy).

    The text holds one a line, or all in one line or in brackets, or a table with a header that names one column of
    angles, or lines of a log with `angle: NUMBER` in each; # begins a comment. A header, a comment or what follows each
    number may say their unit. Rows with the number or the name of their frame are brought into its order. Errors:
    `InputError` for anything else, and for what looks like radians without saying so.
    """
    require_regular(path, "a text file of angles (--angles)")
    lines = [line.partition("#") for line in _text(path).splitlines()]
    bare = [line.strip().rstrip(";,") for line, *_ in lines]
    separator = next((one for one in ";\t" if 2 * sum(one in line for line in bare) > len(lines)), ",")  # as most have
    decimal = {";": ",", "\t": ","}.get(separator, "")
    rows = [row for row in (_cells(line, separator, decimal) for line, *_ in lines) if row]
    said = " ".join(comment for *_, comment in lines)
    words, header = _angle_words(path, rows)
    require(len(words) > 0, f"{path} must hold the frames' angles in degrees, but it holds none.")
    parts = [(found[1], found[2]) if (found := WITH_UNIT.fullmatch(word)) else (word, "") for word in words]
    units = {unit for _, unit in parts}
    require(len(units) == 1, f"{path} must hold angles of one unit, but it holds several; {ADVICE}.")
    values = np.array([number_in(word) for word, _ in parts])
    for word, _ in (part for part, value in zip(parts, values) if math.isnan(value)):
        raise InputError(f"{path} must hold angles in degrees, but it holds {shown(word)}; {ADVICE}.")
    values = finite(f"{path}: angles", values)
    if unit := UNIT.search(f"{units.pop()} {header} {said}".replace("_", " ")):
        return values * (unit_factor(f"{path}: angles", unit[1], ANGLE_UNITS) / ANGLE_UNITS["deg"])
    if unknown := BRACKETED.search(header):
        unit_factor(f"{path}: angles", unknown[1], ANGLE_UNITS)  # refuses it
    return degrees(str(path), values, "in a first line, '# radians' or '# degrees'")


def degrees(label: str, values: np.ndarray, where: str) -> np.ndarray:
    """The angles [N] without a unit, as degrees; `InputError` that says `where` to write the unit, for those that cover
    a half or a whole turn of radians."""
    if values.size >= FEW // 2:
        reach = np.ptp(values) * np.array([[1.0], [values.size / (values.size - 1)]])
        require(
            not (np.abs(reach / WHOLE_TURNS - 1) < CLOSE).any(),
            f"{label} must hold angles in degrees, but those from {values.min():.4g} to {values.max():.4g} look like "
            f"radians; say which they are {where}.",
        )
    return values


def _text(path: Path) -> str:
    """The text of a file in UTF-8, in UTF-16 with a mark, or else in Latin-1; of one list in brackets, the list."""
    if path.suffix.lower() == ".npy":
        found = mapped_array(path, "an array of angles").reshape(-1)
        require(found.dtype.kind in "iuf", f"{path} must hold numbers, but its type is {found.dtype}.")
        return "\n".join(map(str, found.tolist()))
    try:
        content = path.read_bytes()
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    except OSError as error:
        raise InputError(f"--angles must be a text file of angles, but reading {path} failed: {error}.") from None
    alone = LIST.fullmatch(text)
    return (alone[1].replace("\n", " ") if alone else text).replace("\N{MINUS SIGN}", "-")


def _cells(line: str, separator: str, decimal: str) -> list[str]:
    """The entries of a line: between separators if there are any, else between spaces."""
    line = re.sub("[\"']", "", line).strip().strip("[]()").rstrip(",;").strip()
    if separator in line:
        cells = [cell.strip() for cell in line.split(separator)]
        return [re.sub(r"(?<=\d),(?=\d+$)", ".", cell) if decimal else cell for cell in cells]
    return line.split() if _is_number(line.partition(" ")[0]) and not _is_angle(line) else [line] * bool(line)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_angle(cell: str) -> bool:
    """Whether a cell is an angle: a number, with its unit or without, or with the word `angle` before it."""
    return _is_number(cell) or bool(WITH_UNIT.fullmatch(cell) or LABELLED.search(cell))


def _angle_words(path: Path, rows: list[list[str]]) -> tuple[list[str], str]:
    """The entries that are angles, as written, and what their header says of them."""
    if len(rows) == 1:
        return rows[0], ""
    header = [] if not rows or any(map(_is_angle, rows[0])) else rows[0]
    body = rows[1:] if header else rows
    if len(header) == 1 and body and len(body[0]) > 1:
        header = header[0].split()
    units = [""] * len(header)
    if header and body and len(body[0]) == len(header) and any(map(UNIT.fullmatch, body[0])):
        units, body = body[0], body[1:]
    projections = [row for row in body if not FIELD.search(" ".join(row))]
    labelled = [LABELLED.search(" ".join(row)) for row in projections]
    if (found := [each for each in labelled if each]) and len(found) == len(projections):
        return [each[1] for each in found], " ".join((*header, *found[0][2].split()[:1]))
    if all(len(row) == 1 for row in body):
        return [row[0] for row in body], " ".join((*header, *units))
    named = [n for n, name in enumerate(header) if NAME.search(name)]
    if len(named) == 1 and all(len(row) == len(header) for row in body):
        frames = [n for n, name in enumerate(header) if name and ORDER.fullmatch(name)]
        order = [Path(row[frames[0]]) for row in body] if len(frames) == 1 else []
        if len(set(order)) == len(body):  # rows say of which frame they are
            body = [body[order.index(name)] for name in in_order(order)]
        return [row[named[0]] for row in body], f"{header[named[0]]} {units[named[0]]}"
    raise InputError(
        f"{path} must hold one angle a line, or a table with a header that names one column 'angle', but a line holds "
        f"{max(map(len, rows))} numbers; {ADVICE}, with a point before the decimals."
    )


def angles_of(views: Views) -> np.ndarray | None:
    """The angles [N] in degrees of views that turn about the y axis; None for others."""
    rotations = views.rotations
    if not np.allclose(rotations[:, 1, 1], 1, atol=1e-6):
        return None
    return np.rad2deg(np.arctan2(rotations[:, 0, 2] - rotations[:, 2, 0], rotations[:, 0, 0] + rotations[:, 2, 2]))


def tell_steps(angles_deg: np.ndarray, source: str) -> None:
    """Warn of angles [N] whose steps can hardly be meant."""
    steps = np.abs(np.diff(angles_deg))
    if len(steps) and np.median(steps) > WHOLE_TURN:
        warn(f"{source}: angles go on by {np.median(steps):.6g} degrees, more than a turn each; check their unit")


def tell_angles(angles_deg: np.ndarray, source: str) -> None:
    """Say which range the angles [N] span, and where they are from."""
    tell_steps(angles_deg, source)
    note(f"{source}: {len(angles_deg)} angles from {angles_deg.min():.6g} to {angles_deg.max():.6g} degrees")


def tell_views(scan: Scan) -> None:
    """Warn of views whose angles can hardly be meant: all from one side, a narrow fan, some angles twice."""
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
    elif len(twice := _repeated(angles)) and len(twice) < len(views) // 2:
        shown = ", ".join(dict.fromkeys(f"{angle:.6g}°" for angle in twice[:FEW]))
        warn(
            f"more than one frame has the angle {shown}; if one of them is wrong, correct it, or "
            "leave such frames out by --leave-out"
        )


def _repeated(angles: np.ndarray) -> np.ndarray:
    """The repeated ones of `angles` [N] [degrees], once for each frame too many; a turn may end where it began."""
    order = np.argsort(angles % WHOLE_TURN, kind="stable")
    sides = np.append(angles[order] % WHOLE_TURN, angles[order[0]] % WHOLE_TURN + WHOLE_TURN)
    pairs = zip(order, np.append(order[1:], order[0]), np.diff(sides) < SAME_DEG)
    ends = {0, len(angles) - 1}
    return np.array([angles[one] for one, other, same in pairs if same and {int(one), int(other)} != ends])


def is_half_acquisition(scan: Scan) -> bool:
    """Whether views turn about an axis far from the middle of their frames, which stays where it is."""
    views, angles = scan.views, angles_of(scan.views)
    one = scan.exposures.has_one_energy and len(np.unique(scan.exposures.distance)) == 1
    if angles is None or len(views) < 2 or not one or not views.has_one_pixel or scan.is_series:
        return False
    shifts = views.shifts / views.pixel_size
    alike = np.allclose(shifts, shifts[:1], atol=1e-3)
    return bool(alike and abs(shifts[0, 0]) > OFF_CENTRE * views.shape[1])
