"""Runs the examples and writes a page of each: `python docs/site/gallery.py FOLDER [EXAMPLES]`.

An example is run as `python NAME.py out` in a folder of its own. Its page has its title, its text and its code, what it
printed, and the pictures (*.png) that it left in `out`. An example that fails, or says anything on stderr, fails the
build.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def described(source: str) -> tuple[str, str, str]:
    """(title, text, code) of an example: the first line of its docstring, the rest of it, and what follows it.

    The title is the part of the first line before a colon.
    """
    tree = ast.parse(source)
    docstring = ast.get_docstring(tree)
    if not docstring:
        raise ValueError("The example has no docstring, which must hold its title.")
    title, _, text = docstring.partition("\n")
    code = "\n".join(source.splitlines()[tree.body[0].end_lineno :])
    return title.split(": `")[0].rstrip("."), text.strip(), code.strip("\n")


def run(example: Path, folder: Path) -> str:
    """Runs the example in the new `folder` and returns what it printed, with the folder's own path left out."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    environment = os.environ | {"MPLBACKEND": "Agg", "OMP_WAIT_POLICY": "passive"}  # threads share the cores
    command = [sys.executable, str(example.resolve()), "out"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode or done.stderr:
        raise RuntimeError(f"{example.name} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return done.stdout.replace(f"{folder.resolve()}{os.sep}", "")


def page(example: Path, folder: Path, seconds: float, printed: str) -> str:
    """The page in Markdown; pictures are linked where they lie, beside the page in the folder of the example's name."""
    title, text, code = described(example.read_text(encoding="utf-8"))
    parts = [f"# {title}", text, f"```python\n{code}\n```"]
    if printed.strip():
        parts.append(f"It prints:\n\n```text\n{printed.strip()}\n```")
    parts += [f"![{_words(p)}]({example.stem}/out/{p.name})" for p in sorted((folder / "out").glob("*.png"))]
    parts.append(f"*`examples/{example.name}`, run when this page was built, in {seconds:.0f} s.*")
    return "\n\n".join(filter(None, parts)) + "\n"


def _words(picture: Path) -> str:
    return re.sub(r"[_-]+", " ", picture.stem).capitalize()


def build(examples: Path, folder: Path) -> list[Path]:
    """Runs every example and writes its page into `folder`; returns the pages in the order of the examples' names."""
    pages = []
    for example in sorted(examples.glob("*.py")):
        start = time.monotonic()
        printed = run(example, folder / example.stem)
        target = folder / f"{example.stem}.md"
        target.write_text(page(example, folder / example.stem, time.monotonic() - start, printed), encoding="utf-8")
        print(f"{example.name}: {time.monotonic() - start:.0f} s", flush=True)
        pages.append(target)
    return pages


if __name__ == "__main__":
    build(Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "examples", Path(sys.argv[1]))
