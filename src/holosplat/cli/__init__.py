"""The command line: `holosplat simulate | reconstruct | render | export | evaluate | demo`."""

from .commands import main

__all__ = ["main"]
