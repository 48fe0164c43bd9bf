"""The reference of the Python API: what the package and the client say that they offer, drawn by mkdocstrings."""

from __future__ import annotations

from importlib import import_module

_HEAD = """\
# Python

What `import gripmon` gives; the command line calls the same functions. Names are loaded when they are first used.
"""
_CLIENT = """\
## The client

`gripmon.client` is for programs that use the corrected transform;
[Write a controller](../howto/client.md) shows it at work.
"""
_BLOCK = """\
::: {where}
    options:
      heading: {name}
      toc_label: {name}
"""


def page() -> str:
    """The page in Markdown, with a block for mkdocstrings for each public name."""
    package = public_names("gripmon")
    client = {name: where for name, where in public_names("gripmon.client").items() if where not in package.values()}
    parts = [_HEAD, *_blocks(package), _CLIENT, *_blocks(client)]
    return "\n".join(parts)


def public_names(package: str) -> dict[str, str]:
    """What a package lists in ``__all__``: each name, and the full name where it is defined."""
    module = import_module(package)
    names = sorted(name for name in getattr(module, "__all__", ()) if not name.startswith("__"))
    found = {name: getattr(module, name) for name in names}
    return {
        name: f"{value.__module__}.{value.__qualname__}" if hasattr(value, "__qualname__") else f"{package}.{name}"
        for name, value in found.items()
    }


def _blocks(names: dict[str, str]) -> list[str]:
    return [_BLOCK.format(name=name, where=where) for name, where in names.items()]
