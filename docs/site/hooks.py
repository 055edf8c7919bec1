"""What mkdocs does not do by itself: it gets the pages of pages.py, and a check that the site needs no network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pages
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File


def on_config(config: Any) -> Any:
    """Puts the pages of whole sections into the navigation."""
    sections = {"Tutorials": pages.notebook_pages(), "Gallery": pages.gallery_pages(), "API": pages.api_pages()}
    sections |= {"Design": pages.folder_pages("design"), "Lab notebook": pages.folder_pages("notebook")}
    for title, made in sections.items():
        entry = next(entry for entry in config.nav if title in entry)
        first = entry[title]
        entry[title] = [first, *(page for page in sorted(made) if page != first)]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages that are made, and the pictures of gallery and notebooks."""
    made = {**pages.root_pages(), **pages.notebook_pages(), **pages.gallery_pages(), **pages.api_pages()}
    for path, text in made.items():
        files.append(File.generated(config, path, content=text))
    for picture in (*pages.gallery_pictures(), *pages.notebook_pictures()):
        path = picture.relative_to(pages.GALLERY.parent).as_posix()
        files.append(File.generated(config, path, abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turns the repository's links into the site's."""
    made = page.file.src_uri.startswith(("gallery/", "notebooks/", "api/"))
    return markdown if made else pages.linked(markdown, page.file.src_uri)


def on_post_build(config: Any) -> None:
    """Fails the build where a page loads anything from elsewhere."""
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        for address in pages.loads_from_elsewhere(path.read_text(encoding="utf-8")):
            raise PluginError(f"{path} loads {address}: the site must work without a network.")
