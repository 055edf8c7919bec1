"""Docstrings as Markdown: `[m]` is a unit and no link, `name: …` at the start of a line begins an item of a list.

Examples, indented by four spaces, become blocks of Python.
"""

from __future__ import annotations

import re
import textwrap

from griffe import Extension, Module, Object

NAME = r"[a-z][a-z0-9_]*( \[[^\]]+\])?"
ITEM = re.compile(rf"{NAME}(, {NAME})*: \S")
EXAMPLES = re.compile(r"^    >>> .*\n?(?:^    .*\n?|^\n(?=    ))*", re.MULTILINE)
"""A block of Python with its results."""
KEPT = re.compile(r"(``.*?``|`[^`]*`|(?<![^\s(])\*\w[^*\n]*\w\*(?!\w))", re.DOTALL)
"""Code, and emphasis."""


def markdown(text: str) -> str:
    """The text of a docstring, Markdown's special signs escaped outside of code and emphasis, and its fields as a list.

    A field is a line `name: meaning`, or `name, name: meaning`, and the lines up to the next field or empty line.
    Blocks indented by four spaces stay code; those that begin with `>>>` are coloured as Python.
    """
    lines: list[str] = []
    in_list = False
    for line in _escaped(text).splitlines():
        if ITEM.match(line.replace("\\", "")):
            names, meaning = line.split(": ", 1)
            lines += [] if in_list else [""]
            lines.append(f"- **{names}**: {meaning}")
            in_list = True
        elif in_list and line.strip():
            lines.append(f"    {line.strip()}")
        else:
            in_list = False
            lines.append(line)
    return EXAMPLES.sub(lambda found: _python(found[0]), "\n".join(lines).strip("\n"))


def _python(block: str) -> str:
    """An indented block as a fenced one."""
    return f"```pycon\n{textwrap.dedent(block).strip()}\n```\n"


def _escaped(text: str) -> str:
    """Signs of Markdown escaped, but not in `code`, *emphasis*, or blocks indented by four spaces."""

    def plain(part: str) -> str:
        return re.sub(r"([\[\]*_<])", r"\\\1", part)

    paragraphs = re.split(r"(\n{2,})", text)
    done = []
    for paragraph in paragraphs:
        if paragraph.startswith("    "):
            done.append(paragraph)
        else:
            done.append("".join(part if KEPT.fullmatch(part) else plain(part) for part in KEPT.split(paragraph)))
    return "".join(done)


class MarkdownDocstrings(Extension):
    """Turns every docstring that griffe reads into Markdown."""

    def on_instance(self, *, obj: Object, **_: object) -> None:
        """Rewrites the object's docstring, where it has one."""
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)

    def on_module_members(self, *, mod: Module, **_: object) -> None:
        """Forgets `__all__`: what a package passes on from its files is described there, once."""
        mod.exports = None
