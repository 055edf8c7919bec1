"""The pages that the site has beside docs/: of the root, the API reference, gallery and notebooks; and all links.

Links in Markdown files are written for the repository. Here they are turned into links of the site: `docs/method.md` in
README.md becomes `method.md`, `examples/01_….py` becomes the example's page in the gallery.
"""

from __future__ import annotations

import ast
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "holosplat"
BENCH = ROOT / "src" / "holosplat_bench"
GALLERY = ROOT / "build" / "gallery"
NOTEBOOKS = ROOT / "build" / "notebooks"
FROM_ROOT = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages that lie in the repository's root, and where the site has them."""

Pages = dict[str, str]
"""Path on the site → Markdown."""

LINK = re.compile(r"(?<=\]\()([^)#\s]+)(#[^)\s]*)?(?=\))")
LOADED = re.compile(r'<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)="((?:https?:)?//[^"]+)"')
"""What a browser loads from elsewhere when it shows a page."""


# --- links --------------------------------------------------------------------------------------------------


def site_path(path: str) -> str | None:
    """Where the site has a file of the repository (`docs/method.md` → `method.md`), or None if it has not."""
    if path in FROM_ROOT:
        return FROM_ROOT[path]
    if path.startswith("docs/notebooks/"):
        return f"notebooks/{Path(path).stem}.md"
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith("examples/") and path.endswith(".py"):
        return f"gallery/{Path(path).stem}.md"
    return None


def linked(markdown: str, page: str) -> str:
    """The text of the site's page `page`, with the links that it has in the repository turned into the site's."""
    origin = {site: path for path, site in FROM_ROOT.items()}.get(page, f"docs/{page}")

    def turned(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        if re.match(r"[a-z]+:", target):
            return match[0]
        there = site_path(posixpath.normpath(posixpath.join(posixpath.dirname(origin), target)))
        return match[0] if there is None else posixpath.relpath(there, posixpath.dirname(page) or ".") + anchor

    return LINK.sub(turned, markdown)


def loads_from_elsewhere(html: str) -> list[str]:
    """Addresses of scripts, styles and pictures on other machines, which a page without a network must not need."""
    return LOADED.findall(html)


def root_pages() -> Pages:
    """The pages that lie in the repository's root."""
    return {site: (ROOT / path).read_text(encoding="utf-8") for path, site in FROM_ROOT.items()}


def folder_pages(folder: str) -> list[str]:
    """Paths on the site of the pages in a folder of docs/."""
    return [f"{folder}/{path.name}" for path in sorted((ROOT / "docs" / folder).glob("*.md"))]


# --- the API reference --------------------------------------------------------------------------------------


def modules(source: Path) -> dict[str, list[str]]:
    """Room → its public modules by dotted name; rooms of one file are under `holosplat`.

    Modules whose name begins with an underscore, `__main__` and backend files are left out.
    """
    rooms: dict[str, list[str]] = {}
    for path in sorted(source.rglob("*.py")):
        parts = path.relative_to(source).with_suffix("").parts
        name = parts[-1]
        backend = name in ("cpu", "cuda") or name.startswith("triton_")
        if backend or name == "__main__" or (name.startswith("_") and name != "__init__"):
            continue
        room = parts[0] if len(parts) > 1 else "holosplat"
        if parts == ("__init__",):
            continue
        dotted = ".".join([source.name, *(p for p in parts if p != "__init__")])
        rooms.setdefault(room, []).append(dotted)
    return rooms


def _summary(source: Path, dotted: str) -> str:
    """The first paragraph of a module's docstring."""
    stem = source.parent.joinpath(*dotted.split("."))
    path = stem / "__init__.py" if stem.is_dir() else stem.with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split())


def api_pages(source: Path = SOURCE) -> Pages:
    """A page a room, with everything public in it, one of the benchmark, and the list of them."""
    pages = {}
    rows = ["# API reference", "", "Everything public, room by room. `import holosplat as hs` gives:", ""]
    rows += [f"- {line}" for line in _top_level()]
    rows += ["", "| room | what is in it |", "| --- | --- |"]
    bench = [name for names in modules(BENCH).values() for name in names]
    for room, names in sorted({**modules(source), BENCH.name: [BENCH.name, *bench]}.items()):
        title = room if room in ("holosplat", BENCH.name) else f"holosplat.{room}"
        where = BENCH if room == BENCH.name else source
        summary = "The nouns, and what every room uses." if room == "holosplat" else _summary(where, names[0])
        rows.append(f"| [{title}]({room}.md) | {summary} |")
        blocks = [f"# {title}", summary, *(f"::: {name}" for name in names)]
        pages[f"api/{room}.md"] = "\n\n".join(blocks) + "\n"
    return {"api/index.md": "\n".join(rows) + "\n", **pages}


def _top_level() -> Iterator[str]:
    """The names of the package itself, each linked to its description, with the first line of it."""
    import holosplat

    for name in holosplat.__all__:
        thing = getattr(holosplat, name)
        module, own = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
        if module is None or own is None:
            yield f"`{name}`"
            continue
        first = (thing.__doc__ or "").strip().split("\n")[0]
        yield f"[`{name}`][{module}.{own}]: {first}"


# --- the gallery and the notebooks --------------------------------------------------------------------------


def gallery_pages(folder: Path = GALLERY) -> Pages:
    """The pages that docs/site/gallery.py wrote, and the list of them."""
    return _listed("gallery", folder, "# Gallery", "The files in `examples/`, run when the site was built.")


def gallery_pictures(folder: Path = GALLERY) -> Iterator[Path]:
    """The pictures of all examples."""
    return (path for path in sorted(folder.glob("*/out/*.png")))


def notebook_pages(folder: Path = NOTEBOOKS) -> Pages:
    """The pages that docs/site/notebooks.py wrote, and the list of them."""
    said = (
        "Jupyter notebooks, run when the site was built. Each page leads to its notebook, which needs no other files."
    )
    return _listed("notebooks", folder, "# Tutorials", said)


def notebook_pictures(folder: Path = NOTEBOOKS) -> Iterator[Path]:
    """The pictures of all notebooks."""
    return (path for path in sorted(folder.glob("*_files/*.png")))


def _listed(section: str, folder: Path, title: str, said: str) -> Pages:
    """The pages in `folder` and the list of them, each with its first paragraph and its first picture."""
    found = sorted(folder.glob("*.md"))
    if not found:
        raise FileNotFoundError(f"{folder} holds no pages: run `python docs/site/{section}.py {folder}` first.")
    pages = {f"{section}/{path.name}": path.read_text(encoding="utf-8") for path in found}
    rows = [title, "", said, ""]
    for name, text in pages.items():
        heading, rest = text.removeprefix("# ").split("\n", 1)
        first = rest.strip().split("\n\n")[0].replace("\n", " ")
        rows += [f"## [{heading}]({posixpath.basename(name)})", "", *([first] if "```" not in first else []), ""]
        picture = re.search(r"!\[.*", text)
        rows += [picture[0], ""] if picture else []
    return {f"{section}/index.md": "\n".join(rows), **pages}
