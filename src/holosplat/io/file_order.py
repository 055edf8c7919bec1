"""The order in which the frames of numbered files follow each other."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from ..checks import InputError, require, warn

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
    order = sorted(range(len(files)), key=lambda i: _by_words(*split[i]))
    for one, other in pairwise(order):
        if split[one] == split[other]:
            raise InputError(
                f"{files[0].parent} must say by its files' names in which order the frames were taken, but "
                f"{files[one].name} and {files[other].name} have the same number; take one of them out, or choose the "
                "frames' names by --files."
            )
    if len({words for words, _ in split}) > 1:
        _require_decimal(files, names, order)
        _tell_series(files, [split[i][0] for i in order], order)
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


def _tell_series(files: Sequence[Path], words: Sequence[Words], order: Sequence[int]) -> None:
    """Warn of files that differ in the words of their names [N], in this order, of which some are numbered: they may be
    of several series, copies, or none of the frames."""
    counts = Counter(words)
    if len(counts) < len(words):
        firsts = [(files[order[words.index(kind)]].name, count) for kind, count in counts.items()]
        named = ", ".join(f"{count} as {name}" for name, count in firsts[:NAMED])
        more = f" and others of {len(firsts) - NAMED} kinds" if len(firsts) > NAMED else ""
        warn(
            f"{files[0].parent} has files of different names, {named}{more}; they are taken for one series in this "
            "order. If they are not, choose the frames' names by --files, or take the others out"
        )


def _shared(names: Sequence[str]) -> int:
    """The number of characters with which all names begin."""
    return next((n for n, letters in enumerate(zip(*names)) if len(set(letters)) > 1), min(map(len, names)))


def _by_words(words: Words, numbers: Numbers) -> list[str | Decimal]:
    """Words and numbers of a name in turn."""
    return [part for pair in zip(words, (*numbers, Decimal(0))) for part in pair]


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
    split = [[_parted(name, way) for name in names] for way in ways]
    return next((way for way in split if len({words for words, _ in way}) == 1), split[0])


def _parted(name: str, number: str) -> tuple[Words, Numbers]:
    return tuple(re.split(number, name)), tuple(Decimal(text.translate(SIGNS)) for text in re.findall(number, name))
