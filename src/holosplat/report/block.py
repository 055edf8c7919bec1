"""A figure of the page with its caption."""

from __future__ import annotations

import re
from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.figure import Figure

from .style import WIDTH, data_uri


@dataclass(frozen=True)
class Block:
    """One figure of the page: image is a `data:` URI, drawn `width` per cent of the page wide, or `live` is what stands
    in its place, as HTML.

    Without either, `caption` says why there is none.
    """

    heading: str
    caption: str
    title: str = ""
    image: str | None = None
    width: int = 100
    number: int | None = None
    live: Markup | None = None

    @property
    def anchor(self) -> str:
        """The heading as the page links to it."""
        return re.sub(r"\W+", "-", self.heading.lower()).strip("-")

    @property
    def paper(self) -> bool:
        """Whether the image is on white paper, also where the page is dark."""
        return self.image is not None and not self.image.startswith("data:image/svg")

    @property
    def drawn(self) -> bool:
        """Whether there is a figure."""
        return self.image is not None or self.live is not None


def drawn_block(heading: str, caption: str, title: str, figure: Figure) -> Block:
    """`figure` in its block."""
    width = round(100 * float(figure.get_figwidth()) / WIDTH)
    return Block(heading, caption.strip(), title, data_uri(figure), width)
