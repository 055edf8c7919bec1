"""The command line: `holosplat plan | grow | simulate | record | correct | join | reconstruct | surface | …`.

It begins before any library is loaded, and asks whether there is memory for the libraries themselves. Without it,
libraries end the process in ways of their own, or Python says which of them could not be mapped.
"""

from __future__ import annotations

import atexit
import gc
import os
import re
import sys
from traceback import walk_tb

from ..io.room import left_by_limits
from .sentence import give_up

__all__ = ["main"]

# Threads that spin at every barrier triple the time of a step when somebody else needs a core (docs/design/kernels.md).
# It must be said before torch loads its OpenMP; whoever sets the variable keeps the choice.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

MAPPED, RESIDENT = 1.0e9, 0.4e9
"""Bytes of address space and of memory that commands take until they begin with their work."""
UNMAPPED = re.compile("failed to map segment|cannot allocate|cannot enable executable stack", re.IGNORECASE)
"""What loaders of libraries say where there is no memory for one."""
UNSAID = re.compile("returned NULL without setting an exception|error return without exception set")
"""What Python says where it has found no memory, for a module that it compiles or for anything else."""
NO_TORCH = (
    "the package torch must be installed and load, but it does not: install it by the command that the selector under "
    "Get Started on PyTorch's site gives (Compute Platform: CPU where there is no NVIDIA GPU), then try again"
)


def main() -> None:
    """Run the command that the arguments name; where its libraries find no room, one sentence and exit code 2."""
    if "torch" not in sys.modules:
        space, memory = left_by_limits()
        if space < MAPPED:
            give_up(_too_little(f"ulimit -v leaves {space / 1e9:.2g} GB"))
        if memory < RESIDENT:
            give_up(_too_little(f"its control group (a container, a cluster's job) leaves {memory / 1e9:.2g} GB"))
        atexit.register(gc.freeze)  # else Python searches all libraries for garbage as it ends
    try:
        from .entry import main as run

        run()
    except ImportError as error:
        if _of_torch(error):
            give_up(f"{NO_TORCH} ({str(error).splitlines()[0][:200]}).")
        if not UNMAPPED.search(str(error)):
            raise
        give_up(_too_little(f"a library finds no room ({str(error).splitlines()[0][:200]})"))
    except MemoryError:
        give_up(_too_little("its libraries find no room"))
    except SystemError as error:
        if not UNSAID.search(str(error)):
            raise
        give_up(_too_little("Python finds no room to read a library"))


def _of_torch(error: ImportError) -> bool:
    """Whether torch is missing, or is installed but fails as it is loaded, for another reason than memory."""
    inside = (frame.f_globals.get("__name__") == "torch" for frame, _ in walk_tb(error.__traceback__))
    return error.name == "torch" or (any(inside) and not UNMAPPED.search(str(error)))


def _too_little(found: str) -> str:
    needs = f"{MAPPED / 1e9:.1f} GB of address space and {RESIDENT / 1e9:.1f} GB of memory"
    return f"the memory of this process must be at least {needs} before a command begins, but {found}; raise the limit."
