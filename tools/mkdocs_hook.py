"""What ``mkdocs build`` does beyond Markdown: the reference is made from the code, and no page needs the internet."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from pages import api, commands, configuration, examples, fields, messages, rooms

GENERATED = {
    "tutorials/examples.md": examples.page,
    "reference/cli.md": commands.page,
    "reference/configuration.md": configuration.page,
    "reference/api.md": api.page,
    "reference/fields.md": fields.page,
}
_FILLED = {
    "reference/wire.md": messages.put_into,
    "explanation/architecture.md": lambda page: page.replace("<!-- rooms -->", rooms.svg()).replace(
        "<!-- table of rooms -->", rooms.table()
    ),
}
_LOADED = re.compile(
    r"<(?:script|img|iframe|source|audio|video|embed)\b[^>]*\bsrc=[\"']?((?:https?:)?//[^\"' >]+)"
    r"|<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload|preconnect|icon|modulepreload))"
    r"[^>]*\bhref=[\"']?((?:https?:)?//[^\"' >]+)"
    r"|url\([\"']?((?:https?:)?//[^\"')]+)|@import\s+[\"']((?:https?:)?//[^\"']+)"
)


def on_files(files: Files, config: Any) -> Files:
    """The pages that no one types."""
    for path, page in GENERATED.items():
        files.append(File.generated(config, path, content=page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The tables and drawings inside of written pages."""
    fill = _FILLED.get(page.file.src_uri)
    return fill(markdown) if fill else markdown


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Docstrings mark names as Sphinx does; Markdown shows the name alone."""
    return re.sub(r":(?:class|meth|func|data|attr|mod):(?=<code>)", "", html)


def on_post_build(config: Any) -> None:
    """Raises where a built page or style sheet would load something from elsewhere: the site has to work offline."""
    site = Path(config["site_dir"])
    found = [
        f"{path.relative_to(site)} loads {address}"
        for path in sorted([*site.rglob("*.html"), *site.rglob("*.css")])
        for address in loaded_from_elsewhere(path.read_text(encoding="utf-8"))
    ]
    if found:
        raise PluginError("the pages need the internet: " + "; ".join(found))


def loaded_from_elsewhere(text: str) -> list[str]:
    """Addresses of scripts, styles, fonts and pictures that HTML or CSS loads from another place; links don't count."""
    return [next(filter(None, match.groups())) for match in _LOADED.finditer(text)]
