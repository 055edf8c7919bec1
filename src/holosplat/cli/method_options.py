"""The options that say how a reconstruction proceeds: a method, named or from a file, and changes of single fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import UseAppendAction, arg

from ..checks import InputError, require

if TYPE_CHECKING:
    from ..methods import Method


@dataclass(frozen=True)
class MethodOptions:
    """How the reconstruction proceeds."""

    method: str | None = None
    """Method with its options by default: gaussians (what you get without), surfaces, voxels, neural-field …"""
    preset: str | None = None
    """Or: named settings, default (Gaussians as they are without), fast, random, thesis."""
    config: Path | None = None
    """Or: a TOML or JSON file of settings, whole or partial, such as the config.json of another run."""
    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="PATH=VALUE")] = ()
    """Change one field, such as fit.schedule.steps=500 or steps=500; may be given again and again."""
    backend: Literal["auto", "cpu", "cuda", "reference"] | None = None
    """What computes the fit (default: as the settings say, auto); `holosplat backends` lists what there is."""

    def chosen(self) -> Method:
        """The method that the options name; `InputError` for fields that it has not, or cannot take."""
        from ..methods.settings import base, preset, read_method
        from ..tables import overridden

        given = [name for name in ("method", "preset", "config") if getattr(self, name) is not None]
        require(len(given) < 2, f"give only one of {' and '.join(f'--{name}' for name in given)}.")
        if self.config is not None:
            found = read_method(self.config)
        else:
            found = base(self.method) if self.method is not None else preset(self.preset or "default")
        found = overridden(found, self.changes)
        return found if self.backend is None else _on_backend(found, self.backend)


def _on_backend(method: Method, backend: Literal["auto", "cpu", "cuda", "reference"]) -> Method:
    """The method computed by `backend`; `InputError` if it has no choice, or that backend cannot be used here."""
    from ..backends import resolve

    move = getattr(method, "on_backend", None)
    if move is None:
        raise InputError(f"the method {method.kind} has no choice of backends; leave --backend.")
    resolve(backend)  # before the start, which takes its time
    return move(backend)
