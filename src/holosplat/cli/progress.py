"""What commands say while they work: notes on the input, the progress bar, and the exit code of an interrupted one."""

from __future__ import annotations

import logging
import sys
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tqdm import tqdm

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
TOLD = 0.03
"""Share of what was left at first that must be done before the time left is said."""


class _Notes(logging.Handler):
    """Prints what `checks.note` and `checks.warn` say on standard error, above a progress bar, and each of it once."""

    def __init__(self) -> None:
        super().__init__()
        self._known = set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        text = ("warning: " if record.levelno >= logging.WARNING else "") + record.getMessage()
        if text in self._known:
            return
        self._known.add(text)
        tqdm = sys.modules.get("tqdm")
        if tqdm is None:
            print(text, file=sys.stderr)
        else:
            tqdm.tqdm.write(text, file=sys.stderr)


def say_notes() -> None:
    """From now on notes and warnings on the input are printed."""
    logger = logging.getLogger("holosplat")
    logger.setLevel(logging.INFO)
    logger.handlers = [_Notes()]


class ProgressBar:
    """One bar for one stage after another, on standard error."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage = ""

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def show(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        """Stage `stage` is done to `fraction`; the fit's last `record` adds loss, count and steps a second.

        The time left goes by the mean speed since the stage was first shown, from where it then was: what is resumed
        does not begin with nothing.
        """
        from tqdm import tqdm

        if stage != self._stage:
            self._close()
            self._stage = stage
            begun = max(0.0, min(1.0, fraction))
            self._bar = tqdm(
                total=1.0, initial=begun, desc=stage, bar_format=_FORMAT, file=sys.stderr, mininterval=0.2, smoothing=0
            )
        assert self._bar is not None
        if record:
            self._bar.set_postfix_str(_described(record), refresh=False)
        self._bar.bar_format = _WITH_LEFT if self._tells(fraction) else _FORMAT
        self._bar.update(max(0.0, min(1.0, fraction) - self._bar.n))

    def _tells(self, fraction: float) -> bool:
        """Whether enough is done, and not all, to say how long the rest takes."""
        assert self._bar is not None
        return self._bar.initial + TOLD * (1 - self._bar.initial) <= fraction < 1

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.bar_format = _FORMAT
            self._bar.update(max(0.0, 1.0 - self._bar.n) if sys.exc_info()[0] is None else 0.0)
            self._bar.close()
        self._bar = None


_FORMAT = "{desc:28s} {percentage:3.0f}%|{bar:24}| {elapsed}{postfix}"
_WITH_LEFT = _FORMAT.replace("{elapsed}", "{elapsed}, {remaining} left")


def _described(record: dict[str, float]) -> str:
    speed = record["step"] / record["seconds"] if record["seconds"] > 0 else 0.0
    size = f"{record['count']:.0f} Gaussians, " if "count" in record else ""
    return f"loss {record['loss']:.3e}, {size}{speed:.1f} steps/s"
