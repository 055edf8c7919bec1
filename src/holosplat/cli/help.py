"""What `--help` and `--help-all` print: the overview in groups of commands, and the options of a command in two tiers.

The parser knows the options; this module lays them out. `ESSENTIAL` names what `--help` shows of long commands.
"""

from __future__ import annotations

import re
import shutil
import textwrap
import warnings
from argparse import SUPPRESS, Action, ArgumentParser
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import tyro
from tyro.conf import DisallowNone, OmitArgPrefixes

CONFIG = (OmitArgPrefixes, DisallowNone)
"""How the parser names options: without the path of their dataclass, and without None as a value."""
HELP, ALL = ("-h", "--help"), "--help-all"
wrap = partial(textwrap.wrap, break_on_hyphens=False, break_long_words=False)
COLUMN = 26
"""Where the text of options begins."""
WIDEST = 110
"""Columns of the text, at most."""

READ = ("energy_kev", "distance", "pixel_size", "angles", "exposures", "time_frame", "views", "crop", "bin")
MATTER = ("material", "density", "medium", "medium_density", "delta_beta")
METHOD = ("method", "matter", "config", "set")
MESHES = ("length_unit", "material", "density", "medium", "medium_density")
BEAMLINE = ("energy_kev", "distance", "pixel_size", "psf_sigma_px", "views", "angles_deg", "geometry", "test_every")

ESSENTIAL: dict[str, tuple[str, ...]] = {
    "simulate": (*MESHES, *BEAMLINE, "specimen", "photons_per_pixel", "seed", "frame_rate", "frames", "truth"),
    "record": ("photons_per_pixel", "flats", "darks", "seed", "bits", "gain", "truth"),
    "correct": ("method", "normalise", "air", "rings", *READ, "flats", "darks", "leave_out"),
    "align": (*MATTER, "uncertain_shift", "uncertain_angle", "axis_only", "geometry_out", "light", *READ),
    "calibrate": (
        "phantom",
        "length_unit",
        "beads",
        "material",
        "density",
        "uncertain_shift",
        "uncertain_angle",
        *READ,
    ),
    "retrieve": ("method", *MATTER, *READ),
    "reconstruct": (*MATTER, *METHOD, "motion", "refine", "seed", "resume", "strict", *READ, "test_views"),
    "track": (*MATTER, "after", "learned", "cells", "intervals", "seed", "resume", *READ),
    "watch": (*MATTER, *METHOD, "pattern", "seed", *READ),
    "surface": ("scan", "level", "spacing", "smoothing", "steps", "truth", *READ),
    "render": ("split", *READ),
    "evaluate": ("scan", "truth", "json", *READ),
    "rehearse": ("times", "bins", *READ),
    "info": ("picture", *READ, "flats", "darks"),
    "convert": (*MATTER, *READ, "test_views"),
    "train": ("steps", "network", "volume", "seed", "resume"),
    "series plan": ("motion", "window", "overlap", *MATTER, *METHOD, "seed", *READ),
}
"""Command → what `--help` shows of it, beside required options and --force; of other commands it shows everything."""

HEADINGS = {
    "": "Options",
    "what": "Main options",
    "how": "Method",
    "matter": "Material",
    "illumination": "Light",
    "evening": "Light",
    "told": "Metadata",
    "part": "Part of the scan",
    "unknown": "Uncertainty of the geometry",
    "known": "Shape of bodies",
    "each": "Each time",
    "drawn": "Scenes",
    "shown": "Scenes",
    "ranges": "Survey",
    "writing": "Output",
    "live": "Live view",
}
"""Name of a group of options → its heading; others are their names."""
APPENDED = re.compile(r"\s*\((?:default: ([^()]*)|repeatable|required|fixed to: .*)\)$")
"""What the parser puts behind the text of an option."""
REPEATED = re.compile(r"\[(\S.*) \[\1 \.\.\.\]\]|\{([A-Z ]*)\}")
"""How the parser shows several values."""
UNSAID = ("None", "False", "True", "")
"""Defaults that say nothing."""


@dataclass(frozen=True)
class Option:
    """An option of a command: its name, such as `pixel_size`, how it is called, what it is, its default as the parser
    shows it (empty: none), the heading above it, whether it is required, and the parser's action."""

    name: str
    called: str
    text: str
    default: str
    heading: str
    required: bool
    action: Action

    @property
    def key(self) -> str:
        """What it is called in a pipeline file, and behind -- on the command line."""
        return self.name.replace("_", "-")

    @property
    def is_bare(self) -> bool:
        """Whether it has no flag."""
        return not self.action.option_strings

    @property
    def is_switch(self) -> bool:
        """Whether it is on or off."""
        return self.action.nargs == 0

    @property
    def is_repeatable(self) -> bool:
        """Whether each further call of it adds a value."""
        return (self.action.help or "").endswith("(repeatable)")

    def lines(self, width: int) -> Iterator[str]:
        """The option and its text, in `width` columns."""
        said = self.text
        if self.required and not self.is_bare:
            said += " (required)"
        elif self.default not in UNSAID and "(default:" not in said:
            said += f" (default: {self.default})"
        words = wrap(said, max(width - COLUMN, 20)) or [""]
        if len(self.called) + 4 > COLUMN:
            yield f"  {self.called}"
        else:
            yield f"  {self.called:{COLUMN - 2}}{words.pop(0)}".rstrip()
        yield from (" " * COLUMN + word for word in words)


def parser_of(function: Callable[..., Any], name: str) -> ArgumentParser:
    """The parser of the command `name`, whose arguments are those of `function`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # nothing else says what the parser takes
        return cast(ArgumentParser, tyro.extras.get_parser(function, prog=f"holosplat {name}", config=CONFIG))


def acts_of(parser: ArgumentParser) -> Mapping[str, ArgumentParser]:
    """The acts of a command, by name; empty where it has none."""
    return next((each.choices for each in parser._actions if isinstance(each.choices, dict)), {})


def options_of(parser: ArgumentParser) -> list[Option]:
    """The options of a parser in their order, those without a flag first."""
    found = []
    for group in parser._action_groups:
        title = (group.title or "").removesuffix("options").strip().split(".")[-1]
        for action in group._group_actions:
            if action.dest not in (SUPPRESS, "help") and not isinstance(action.choices, dict):
                found.append(_option(action, HEADINGS.get(title, title.replace("-", " ").capitalize())))
    return found


def _option(action: Action, heading: str) -> Option:
    text = " ".join((action.help or "").replace("%%", "%").split())
    default, text = APPENDED.search(text), APPENDED.sub("", text)
    shown = (default[1] or "" if default else "").strip()
    if not action.option_strings:
        name = action.dest.rpartition(".")[2]
        many = " ..." if action.nargs in ("*", "+") else ""
        return Option(name, name.upper() + many, text, shown, "Arguments", action.required, action)
    flag = action.option_strings[-1 if shown == "True" else 0]
    metavar = REPEATED.sub(lambda found: found[2] or f"{found[1]} ...", str(action.metavar or "")).replace(
        "STR", "TEXT"
    )
    name = action.option_strings[0].removeprefix("--").replace("-", "_")
    return Option(name, f"{flag} {metavar}".strip(), text, shown, heading, action.required, action)


def is_essential(name: str, option: Option) -> bool:
    """Whether `--help` of the command `name` shows an option."""
    chosen = ESSENTIAL.get(name)
    return chosen is None or option.required or option.is_bare or option.name in (*chosen, "force")


def page(name: str, parser: ArgumentParser, everything: bool) -> str:
    """The help of a command: what it does, its arguments, and its options under headings; everything: all of them."""
    width = min(shutil.get_terminal_size().columns, WIDEST)
    options, acts = options_of(parser), acts_of(parser)
    shown = [one for one in options if everything or is_essential(name, one)]
    usage = " ".join(one.called if one.action.nargs != "?" else f"[{one.called}]" for one in options if one.is_bare)
    required = " ".join(one.called for one in options if one.required and not one.is_bare)
    words = f"usage: holosplat {name} {'{' + ','.join(acts) + '}' if acts else ''}{usage} {required} [OPTIONS]"
    lines = wrap(" ".join(words.split()), width, subsequent_indent="    ")
    for paragraph in (parser.description or "").split("\n\n"):
        lines += ["", *wrap(" ".join(paragraph.split()), width)]
    for act, inner in acts.items():
        lines += _row(act, " ".join((inner.description or "").split("\n\n")[0].split()), width)
    for heading in dict.fromkeys(one.heading for one in shown):
        lines += ["", heading]
        lines += [line for one in shown if one.heading == heading for line in one.lines(width)]
    if len(shown) < len(options):
        lines += ["", f"{len(options) - len(shown)} more options: holosplat {name} {ALL}"]
    return "\n".join(lines)


def overview(groups: Mapping[str, Sequence[tuple[str, str]]], description: str) -> str:
    """The help of the program: pairs of command and summary under the heading of their group."""
    width = min(shutil.get_terminal_size().columns, WIDEST)
    lines = ["usage: holosplat COMMAND [OPTIONS]", "", description]
    for heading, commands in groups.items():
        lines += ["", heading]
        for name, summary in commands:
            lines += _row(name, summary, width)
    ends = (
        f"holosplat COMMAND --help shows the essential options of a command, {ALL} all.",
        "holosplat --version says which one this is.",
    )
    return "\n".join([*lines, "", *ends])


def _row(name: str, text: str, width: int) -> list[str]:
    return wrap(text, width, initial_indent=f"  {name:12}", subsequent_indent=" " * 14)
