"""Runs the notebooks by nbclient and writes a page of each: `python docs/site/notebooks.py FOLDER [NOTEBOOKS]`.

Notebooks stand in the repository without outputs. A cell that fails, or says anything on stderr, fails the build.
Pictures of the page NAME.md are in NAME_files beside it.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter
from traitlets.config import Config

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 300
"""Seconds that a cell may take."""


def executed(notebook: Path, folder: Path) -> nbformat.NotebookNode:
    """The notebook after all its cells were run, with `folder` as the working folder.

    Errors: `RuntimeError` where a cell fails, or writes to stderr.
    """
    found = nbformat.read(notebook, as_version=4)
    settings = folder / ".ipython"
    settings.mkdir(parents=True, exist_ok=True)
    # Matplotlib draws into the notebook; IPython keeps its settings here, and none in the user's home.
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    environment |= {"IPYTHONDIR": str(settings.resolve()), "OMP_WAIT_POLICY": "passive"}
    with tempfile.TemporaryDirectory() as private:  # sockets in it, not ports, which other users could connect to
        kernel = Config(KernelManager={"transport": "ipc", "ip": f"{private}/kernel"})
        where = {"metadata": {"path": str(folder)}}
        client = NotebookClient(found, timeout=LONGEST_S, kernel_name="python3", resources=where, config=kernel)
        try:
            client.execute(env=environment)
        except CellExecutionError as error:
            raise RuntimeError(f"{notebook.name} fails:\n{error}") from None
    for number, cell in enumerate(found.cells):
        for output in cell.get("outputs", ()):
            if output.get("name") == "stderr":
                raise RuntimeError(f"{notebook.name}, cell {number}, says on stderr:\n{output['text']}")
    return found


def write_page(notebook: Path, folder: Path) -> Path:
    """Runs the notebook and writes its page, and its pictures, into `folder`."""
    start = time.monotonic()
    found = executed(notebook, folder)
    seconds = time.monotonic() - start
    names = {"unique_key": notebook.stem, "output_files_dir": f"{notebook.stem}_files"}
    text, resources = MarkdownExporter().from_notebook_node(found, resources=names)
    for name, content in resources["outputs"].items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    said = f"*[{notebook.name}]({notebook.name}), run when this page was built, in {seconds:.0f} s.*"
    page = folder / f"{notebook.stem}.md"
    page.write_text(f"{text.strip()}\n\n{said}\n", encoding="utf-8")
    print(f"{notebook.name}: {seconds:.0f} s", flush=True)
    return page


def build(notebooks: Path, folder: Path) -> list[Path]:
    """Pages of all notebooks, in the order of their names."""
    folder.mkdir(parents=True, exist_ok=True)
    return [write_page(notebook, folder) for notebook in sorted(notebooks.glob("*.ipynb"))]


if __name__ == "__main__":
    build(Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "docs" / "notebooks", Path(sys.argv[1]))
