"""Input that nobody vouches for: it declares no more than it can hold."""

from __future__ import annotations

import os
import re

from ..checks import require

RATIO = 1100
"""Declared bytes over those of a file, at most: deflate, the densest that readers know, makes zeros 1032 times smaller.
"""
SMALL = 1 << 26
"""Bytes that any file may declare."""
DEEPEST = 64
"""Levels of nested elements, groups or tables, at most."""
TAG = re.compile(rb"<(/?)([A-Za-z!?][^\s>/]*)[^>]*?(/?)>")
COUNT = re.compile(rb"\bNumberOf\w+\s*=\s*[\"']\s*(\d+)\s*[\"']")
APPENDED = b"<AppendedData"


def require_declared(label: str, declared: int, held: int) -> None:
    """`InputError` if a file declares more bytes than the `held` ones can be packed into."""
    require(
        declared <= max(SMALL, RATIO * held),
        f"{label} declares {declared:.3g} bytes of values, but holds {held:.3g}; it is damaged, or no honest file.",
    )


def require_memory(label: str, size: int) -> None:
    """`InputError` if `size` bytes are more than the memory of this machine."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    require(
        size <= whole,
        f"{label} takes {size / 1e9:.3g} GB, but this machine has {whole / 1e9:.3g} GB of memory; take a part of it.",
    )


def xml_fault(content: bytes) -> str:
    """Why an XML file of VTK is not given to its parser: it is nested too deeply, or declares more points or cells than
    it has room for; empty if there is no such fault. What is appended to it is no XML and is passed over."""
    text = content[: content.index(APPENDED)] if APPENDED in content else content
    for count in COUNT.finditer(text):
        if int(count[1]) > max(SMALL, RATIO * len(content)):
            return f"it declares {count[1].decode()[:30]} points or cells, but has {len(content)} bytes"
    depth = 0
    for tag in TAG.finditer(text):
        if tag[2][:1] in b"!?" or tag[3]:
            continue
        depth += -1 if tag[1] else 1
        if depth > DEEPEST:
            return f"its elements are nested more than {DEEPEST} deep"
    return ""
