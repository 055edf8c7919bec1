"""What commands take while nothing disturbs them."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from fault_shop import Shop, Writer
from forked import at_events, run, size_of

HANG, SLOWER = 60.0, 10
"""A command hangs that takes more seconds than this, and so many times what it takes undisturbed under the same load.
"""


@dataclass(frozen=True)
class Cost:
    """What a command takes undisturbed: seconds, how often it changes files, and bytes of the largest that it makes."""

    seconds: float
    changes: int
    largest: int

    @property
    def limit(self) -> float:
        """Seconds from which on the command hangs."""
        return max(HANG, SLOWER * self.seconds)

    @classmethod
    def of(cls, shop: Shop, writer: Writer) -> Cost:
        """Measure it; what a command cannot do undisturbed ends all trials."""
        with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile() as counted:
            folder = Path(name)
            command = writer.command(shop, folder)
            ended = run(
                command,
                limit=600,
                first=lambda: at_events(folder, lambda number: os.pwrite(counted.fileno(), b".", number)),
            )
            if ended.code != 0:
                raise SystemExit(f"{writer.name} must work before it is disturbed, but: {ended.said}")
            changes = max(0, os.fstat(counted.fileno()).st_size - 1)
            return cls(ended.seconds, changes, size_of(folder / writer.out))
