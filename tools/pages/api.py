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


def page() -> str:
    """The page in Markdown, with a block for mkdocstrings for each public name."""
    parts = [_HEAD, *map(_block, public_names("gripmon"))]
    return "\n".join([*parts, _CLIENT, *map(_block, public_names("gripmon.client"))])


def public_names(package: str) -> list[str]:
    """Full names of what a package lists in ``__all__``, each by the module that defines it; modules aside."""
    module = import_module(package)
    names = [name for name in getattr(module, "__all__", ()) if not name.startswith("__")]
    found = ((name, getattr(module, name)) for name in sorted(names))
    return [
        f"{value.__module__}.{value.__qualname__}" if hasattr(value, "__qualname__") else f"{package}.{name}"
        for name, value in found
    ]


def _block(name: str) -> str:
    return f"::: {name}\n"
