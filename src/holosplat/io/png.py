"""Grey images from and to PNG files, of 8 or 16 bits."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from ..checks import InputError, require

PngKind = Literal["grey16", "rgba8"]
LEVELS: dict[PngKind, int] = {"grey16": 65535, "rgba8": 255}
"""The white of each kind."""


def write_png(path: Path, image: np.ndarray, kind: PngKind) -> None:
    """Write `image` [H, W], black at 0 and white at 1, rounded to the levels of `kind` and cut off beyond them."""
    levels = np.rint(np.clip(image, 0.0, 1.0) * LEVELS[kind])
    if kind == "grey16":
        Image.fromarray(levels.astype(np.uint16)).save(path, format="PNG")
    else:
        grey = Image.fromarray(levels.astype(np.uint8))
        Image.merge("RGBA", (grey, grey, grey, Image.new("L", grey.size, 255))).save(path, format="PNG")


def read_png(path: Path) -> tuple[np.ndarray, int]:
    """An image's levels [H, W] as they stand in the file, and its white: 255 or 65535.

    Colours must be equal and alpha opaque; `InputError` otherwise, or if the file is damaged.
    """
    try:
        with Image.open(path, formats=("PNG",)) as image:
            mode, values = image.mode, np.asarray(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} must be a complete PNG image, but it is damaged or none: {error}.") from None
    if mode.startswith("I"):  # 16 bits: "I;16", and "I" in older versions of Pillow
        return values, LEVELS["grey16"]
    require(mode in ("L", "LA", "RGB", "RGBA"), f"{path} must be a grey image of 8 or 16 bits, but its kind is {mode}.")
    bands = values if values.ndim == 3 else values[..., None]
    if mode.endswith("A"):
        require(bool((bands[..., -1] == 255).all()), f"{path} must be opaque, but its alpha is not; fill it in first.")
        bands = bands[..., :-1]
    require(bool((bands == bands[..., :1]).all()), f"{path} must be grey, but it has colours; make it grey first.")
    return bands[..., 0], LEVELS["rgba8"]
