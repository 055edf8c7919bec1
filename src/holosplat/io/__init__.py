"""Files: one module a format. Readers check what they read; writers replace a file whole or not at all.

`read` opens a scan of any format.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .formats import read as read

__all__ = ["read"]


def __getattr__(name: str) -> Any:
    if name != "read":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .formats import read  # imported when it is used: whoever writes JSON needs no HDF5

    return read
