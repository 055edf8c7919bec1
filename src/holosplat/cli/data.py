"""`holosplat data`: public sample data, listed and fetched."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from .places import with_checked_arguments


def _list() -> None:
    """List the sample data: name, what it is, source, licence, and what is known of it."""
    from ..io.samples import samples

    for name, sample in samples().items():
        how = f"{sample.bytes / 1e6:.1f} MB" if sample.url else f"{sample.bytes / 1e6:.1f} MB, only --from a folder"
        print(f"{name}: {sample.title} ({how})")
        print(f"  source: {sample.source}; licence: {sample.licence}\n  {sample.facts}")


def _fetch(name: Positional[str], folder: Annotated[Path | None, arg(name="from")] = None) -> None:
    """Fetch sample data into the cache, and print its path with the options that say what is known of it.

    What is printed goes into a command as it is: holosplat reconstruct $(holosplat data fetch NAME).

    Args:
        name: Name of the data, as `holosplat data list` has it.
        folder: A folder that has the file already; nothing is then fetched.
    """
    from ..io.samples import fetched, sample

    wanted = sample(name)
    path, options = fetched(wanted, folder)
    again = f"$(holosplat data fetch {_again(name, folder)})"
    print(f"{wanted.facts}\ngo on: {wanted.next.format(data=again)}", file=sys.stderr)
    print(path, *options)


def _again(name: str, folder: Path | None) -> str:
    return name if folder is None else f"{name} --from {shlex.quote(str(folder))}"


def data(
    act: Annotated[
        Annotated[None, subcommand("list", constructor=with_checked_arguments(_list))]
        | Annotated[None, subcommand("fetch", constructor=with_checked_arguments(_fetch))],
        arg(name=""),
    ],
) -> None:
    """Sample data of other people: list it, or fetch one into the cache (list, fetch NAME)."""
