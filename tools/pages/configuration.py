"""The reference of the configuration, from the settings' types: key, type, unit, default, bounds, meaning."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect as mi

from gripmon.daemon.config.settings import Settings
from gripmon.model.fields import described
from pages import cell

UNITS = {
    "_px2": "px²", "_px": "px", "_m_per_sqrt_s": "m/√s", "_rad_per_sqrt_s": "rad/√s", "_per_s": "1/s",
    "_per_day": "1/day", "_per_month": "1/month", "_m": "m", "_rad": "rad", "_s": "s", "_ns": "ns", "_hz": "Hz",
    "_bytes": "bytes", "_sigmas": "standard deviations", "_frames": "frames",
}  # fmt: skip
"""Endings of keys and what they are in; the first that fits counts."""

_HEAD = """\
# Configuration

A configuration is one YAML file. `gripmon check FILE` validates it and says of each mistake the file, the key, what is
wrong and what would be right. The files in `configs/` are complete examples with a comment at each key. A key without a
default has to be given; a key that is not listed here is refused. Paths are relative to the file.
"""


class Key(NamedTuple):
    """A row: dotted ``path``, and texts for the columns; ``default`` is empty for a key that has to be given."""

    path: str
    type: str
    unit: str
    default: str
    bounds: str
    meaning: str


def page() -> str:
    """The page in Markdown."""
    parts = [_HEAD]
    for title, about, keys in _sections(mi.type_info(Settings), "", ""):
        parts.append(_section(title, about, keys))
    return "\n".join(parts)


def _section(title: str, about: str, keys: list[Key]) -> str:
    rows = [f"| `{k.path}` | {k.type} | {k.unit} | {k.default} | {k.bounds} | {k.meaning} |" for k in keys]
    head = "| key | type | unit | default | bounds | meaning |\n| --- | --- | --- | --- | --- | --- |"
    mark = "###" if "." in title or title.startswith("laser") else "##"
    name = f"`{title}`" if title else "Top level"
    return f"{mark} {name}\n\n{about}\n\n" + (head + "\n" + "\n".join(rows) + "\n" if rows else "")


def _sections(node: mi.Type, path: str, tag: str) -> Iterator[tuple[str, str, list[Key]]]:
    """Of a struct: its own keys first, then the structs below it; alternatives by their tag, one after the other."""
    node = _bare(node)
    if isinstance(node, mi.UnionType):
        for each in node.types:
            if isinstance(_bare(each), mi.StructType):
                yield from _sections(each, path, "")
        return
    assert isinstance(node, mi.StructType)
    keys, below = [], []
    for field in node.fields:
        dotted = f"{path}.{field.encode_name}" if path else field.encode_name
        if _is_section(field.type):
            below.append((field.type, dotted))
        else:
            keys.append(_key(dotted, field))
    if node.tag_field:
        dotted = f"{path}.{node.tag_field}"
        keys.insert(0, Key(dotted, f"`{node.tag}`", "", "", "", "chooses this table"))
    about = inspect.cleandoc(node.cls.__doc__ or "").split("\n\n")[0].replace("``", "`").replace("\n", " ")
    title = f"{path}: {node.tag}" if node.tag_field else path
    yield title, about, keys
    for each, dotted in below:
        yield from _sections(each, dotted, "")


def _bare(node: mi.Type) -> mi.Type:
    while isinstance(node, mi.Metadata):
        node = node.type
    return node


def _is_section(node: mi.Type) -> bool:
    bare = _bare(node)
    if isinstance(bare, mi.UnionType):
        return any(isinstance(_bare(each), mi.StructType) for each in bare.types)
    return isinstance(bare, mi.StructType)


def _key(dotted: str, field: mi.Field) -> Key:
    meaning = described(field.type)
    name = dotted.rpartition(".")[2]
    unit = next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")
    found = re.search(r" \((no unit|number|[\w/²√]+(?: per [^()]*)?)\)$", meaning)
    if found:
        unit, meaning = (unit or found[1]).replace("no unit", "").replace("number", ""), meaning[: found.start()]
    return Key(dotted, _type(field.type), unit, _default(field), _bounds(field.type), cell(meaning))


def _type(node: mi.Type) -> str:
    node = _bare(node)
    if isinstance(node, mi.UnionType):
        return " or ".join(_type(each) for each in node.types)
    if isinstance(node, mi.LiteralType):
        return ", ".join(f"`{value}`" for value in node.values)
    if isinstance(node, mi.EnumType):
        return ", ".join(f"`{value.value}`" for value in node.cls)
    if isinstance(node, mi.TupleType):
        return f"{len(node.item_types)} × {_type(node.item_types[0])}"
    if isinstance(node, mi.VarTupleType | mi.ListType):
        size = getattr(node, "min_length", None)
        inner = _type(node.item_type)
        return f"{size} × {inner}" if size and size == node.max_length else f"list of {inner}"
    if isinstance(node, mi.DictType):
        return f"mapping of {_type(node.key_type)} to {_type(node.value_type)}"
    names = {mi.FloatType: "number", mi.IntType: "integer", mi.StrType: "text", mi.BoolType: "true or false"}
    return "null" if isinstance(node, mi.NoneType) else names[type(node)]


def _default(field: mi.Field) -> str:
    if field.required:
        return ""
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "none"
    value = getattr(value, "value", value)
    text = {True: "true", False: "false"}[value] if isinstance(value, bool) else value
    if isinstance(value, tuple | list):
        text = ", ".join(str(getattr(each, "value", each)) for each in value) or "empty"
    return f"`{text}`"


def _bounds(node: mi.Type) -> str:
    node = _bare(node)
    if isinstance(node, mi.UnionType):
        return next((text for each in node.types if (text := _bounds(each))), "")
    signs = {"gt": "> ", "ge": "≥ ", "lt": "< ", "le": "≤ ", "min_length": "length ≥ ", "max_length": "length ≤ "}
    limits: list[str] = []
    for name, sign in signs.items():
        value: Any = getattr(node, name, None)
        if value is not None and not (name == "min_length" and value == 1):
            limits.append(f"{sign}{value}")
    return ", ".join(limits)
