"""The notebooks of the documentation: whole, without outputs, in the navigation, and they run."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
import pytest
import yaml

from helpers.docs_site import loaded

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(path: Path) -> list[dict[str, Any]]:
    """The cells of a notebook."""
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def complaints(found: list[dict[str, Any]]) -> list[str]:
    """What a notebook in the repository must not hold: outputs, counts of execution, commands of IPython."""
    said = []
    for number, cell in enumerate(found):
        if cell["cell_type"] != "code":
            continue
        if cell["outputs"] or cell["execution_count"] is not None:
            said.append(f"cell {number} has outputs; clear them")
        if re.search(r"^\s*[%!]", "".join(cell["source"]), re.MULTILINE):
            said.append(f"cell {number} has a command of IPython")
    return said


def test_there_are_notebooks():
    assert [path.stem[:2] for path in NOTEBOOKS] == [f"{k + 1:02d}" for k in range(len(NOTEBOOKS))]
    assert len(NOTEBOOKS) >= 4


@each
def test_a_notebook_holds_no_outputs(path):
    assert complaints(cells(path)) == []
    assert path.stat().st_size < 20_000


def test_outputs_and_commands_are_seen():
    code = {"cell_type": "code", "outputs": [], "execution_count": None, "source": ["1 + 1"]}
    assert complaints([{"cell_type": "markdown"}, code]) == []
    assert complaints([code | {"outputs": [{}]}]) == ["cell 0 has outputs; clear them"]
    assert complaints([code, code | {"source": ["a\n", "!ls"]}]) == ["cell 1 has a command of IPython"]


@each
def test_a_notebook_begins_with_its_title_and_what_it_does(path):
    """Of which the list of notebooks is made."""
    first = cells(path)[0]
    assert first["cell_type"] == "markdown"
    assert re.match(r"# [^\n]+\n\n\S", "".join(first["source"]))


@each
def test_a_notebook_fits_its_format(path):
    nbformat = pytest.importorskip("nbformat", reason="the extra `docs` is not installed")
    nbformat.validate(nbformat.read(path, as_version=4))
    assert json.loads(path.read_text(encoding="utf-8"))["nbformat"] == 4


@each
def test_links_of_a_notebook_lead_somewhere(path):
    text = "\n".join("".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == "markdown")
    targets = re.findall(r"\]\(([^)#\s]+)\)", text)
    assert [target for target in targets if not (path.parent / target).is_file()] == []


@pytest.mark.slow
@pytest.mark.usefixtures("plain_light", "unjudged_runs", "quick_likelihood")
@each
def test_a_notebook_runs_offline(path, tmp_path, monkeypatch):
    """Its code in plain Python, in an empty folder; what its last lines give is shown as Jupyter would show it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("socket.socket.connect", _no_network)
    plt.switch_backend("agg")
    names: dict[str, Any] = {}
    rich = 0
    for cell in cells(path):
        if cell["cell_type"] == "code":
            shown = last_value("".join(cell["source"]), names)
            rich += hasattr(shown, "_repr_html_") and shown._repr_html_().startswith("<div")
    plt.close("all")
    assert rich >= 1


def _no_network(*given: object) -> None:
    raise AssertionError("a notebook must fetch nothing")


def last_value(source: str, names: dict[str, Any]) -> Any:
    """Runs the code of a cell among `names`; what its last line gives, if that is an expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "a cell", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), "a cell", "eval"), names)


# --- the pages ----------------------------------------------------------------------------------------------


def test_every_notebook_is_in_the_navigation(tmp_path):
    """By the list of the pages that are made of them."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = yaml.safe_load(text[text.index("\nnav:") :])["nav"]
    assert {"Tutorials": "notebooks/index.md"} in nav
    for path in NOTEBOOKS:
        (tmp_path / f"{path.stem}.md").write_text("# A title\n\nWords.\n\n![png](x_files/a.png)\n", encoding="utf-8")
    made = loaded("pages").notebook_pages(tmp_path)
    assert list(made) == ["notebooks/index.md", *(f"notebooks/{path.stem}.md" for path in NOTEBOOKS)]
    entry = f"## [A title]({NOTEBOOKS[0].stem}.md)\n\nWords.\n\n![png](x_files/a.png)"
    assert entry in made["notebooks/index.md"]


def test_notebooks_that_were_not_run_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"site/notebooks\.py"):
        loaded("pages").notebook_pages(tmp_path)


@pytest.fixture(scope="module")
def runner() -> ModuleType:
    """docs/site/notebooks.py."""
    for name in ("nbclient", "nbconvert", "ipykernel"):
        pytest.importorskip(name, reason="the extra `docs` is not installed")
    return loaded("notebooks")


def write(path: Path, *codes: str) -> Path:
    """A notebook of a title and cells of code."""
    from nbformat import v4, write

    write(v4.new_notebook(cells=[v4.new_markdown_cell("# A\n\nB."), *map(v4.new_code_cell, codes)]), path)
    return path


def test_a_notebook_becomes_a_page(runner, tmp_path):
    draw = "import matplotlib.pyplot as plt\nplt.plot([1, 2])\nplt.show()"
    rich = "class A:\n    def _repr_html_(self):\n        return '<div>rich</div>'\nA()"
    write(tmp_path / "01_a.ipynb", "print(1 + 1)", rich, draw)
    (page,) = runner.build(tmp_path, tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# A\n\nB.\n")
    assert "```python\nprint(1 + 1)\n```" in text
    assert "    2\n" in text
    assert "<div>rich</div>" in text
    assert "](01_a.ipynb)" in text
    (picture,) = loaded("pages").notebook_pictures(tmp_path / "out")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"![png](01_a_files/{picture.name})" in text


@pytest.mark.parametrize(
    ("code", "said"), [("1 / 0", "ZeroDivisionError"), ("import sys\nsys.stderr.write('careful')", "cell 1.*stderr")]
)
def test_a_cell_that_fails_or_warns_fails_the_build(runner, tmp_path, code, said):
    write(tmp_path / "01_a.ipynb", code)
    with pytest.raises(RuntimeError, match=rf"(?s)^01_a.ipynb.*{said}"):
        runner.build(tmp_path, tmp_path / "out")
