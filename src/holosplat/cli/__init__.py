"""The command line: `holosplat plan | grow | simulate | record | correct | join | reconstruct | surface | …`."""

import os

# Threads that spin at every barrier triple the time of a step when somebody else needs a core (docs/design/kernels.md).
# It must be said before torch loads its OpenMP; whoever sets the variable keeps the choice.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from .start import main

__all__ = ["main"]
