"""What the scripts that draw the docs' figures have in common."""

from __future__ import annotations

import subprocess
from pathlib import Path

from PIL import Image


def in_few_colours(source: Path, target: Path, colours: int, width: int | None = None) -> None:
    """The picture `source` as `target`: at most `width` pixels wide, in so many `colours`, small enough to commit."""
    image = Image.open(source).convert("RGB")
    if width is not None and image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    image.quantize(colours, dither=Image.Dither.NONE).save(target, optimize=True)


def _described() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return shown.stdout.strip() or "unknown"


COMMIT = _described()
"""The commit that draws, with a mark if the tree was changed before."""
