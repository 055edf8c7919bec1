"""The order in which the frames of numbered files follow each other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..checks import InputError

NUMBER = re.compile(r"\d+(?:\.\d+)*")
Words = tuple[str, ...]
Numbers = tuple[float, ...]


def in_order(files: Sequence[Path]) -> list[Path]:
    """The files in the order of the running number in their names, which may have a sign or decimals.

    Of several numbers that run differently, the running one counts the files in steps of one, or is the only whole
    number that no two files share. Names without such a number are sorted by their words and numbers from left to
    right. Errors: `InputError` where two numbers could be the running one.
    """
    files = sorted(files)
    split = _split([file.stem.lower() for file in files])
    if len({words for words, _ in split}) > 1 or len(files) < 2:
        return [files[i] for i in sorted(range(len(files)), key=lambda i: _by_words(*split[i]))]
    columns = np.array([numbers for _, numbers in split]).reshape(len(files), -1)
    columns = columns[:, (columns != columns[0]).any(axis=0)]
    counting = [column for column in columns.T if len(np.unique(column)) == len(column)]
    orders = {tuple(np.argsort(column)): column for column in counting}
    if len(orders) > 1:
        whole = {order: column for order, column in orders.items() if (column == np.rint(column)).all()}
        running = {order: column for order, column in whole.items() if np.ptp(column) == len(files) - 1}
        orders = running or whole
    if len(orders) == 1:
        return [files[i] for i in next(iter(orders))]
    if counting:
        raise InputError(
            f"{files[0].parent} must say by its files' names in which order the frames were taken, but several numbers "
            f"in {files[0].name} and the others run differently; leave one number in the names."
        )
    return [files[i] for i in np.lexsort(columns.T[::-1])]


def _by_words(words: Words, numbers: Numbers) -> list[str | float]:
    """Words and numbers of a name in turn."""
    return [part for pair in zip(words, (*numbers, 0.0)) for part in pair]


def _split(names: Sequence[str]) -> list[tuple[Words, Numbers]]:
    """The words of names between their numbers, and the numbers.

    `1.10` beside `1.9` is two numbers, as in versions; elsewhere a point within a number is that of decimals. A minus
    or plus is a sign where it does not join a word with the number, or where some of the names lack it.
    """
    found = [NUMBER.findall(name) for name in names]
    fractions = [text.partition(".")[2] for texts in found for text in texts if "." in text]
    decimal = not any("." in text for text in fractions) and (
        len({len(text) for text in fractions}) < 2
        or not any(len(text) > 1 and text.endswith("0") for text in fractions)
    )
    number = r"\d+(?:\.\d+)?" if decimal else r"\d+"
    plain = [_parted(name, rf"(?<![a-z0-9])[-+]{number}|{number}") for name in names]
    signed = [_parted(name, rf"[-+]?{number}") for name in names]
    if len({words for words, _ in plain}) > 1 and len({words for words, _ in signed}) == 1:
        return signed
    return plain


def _parted(name: str, number: str) -> tuple[Words, Numbers]:
    return tuple(re.split(number, name)), tuple(float(text) for text in re.findall(number, name))
