"""A configuration as YAML with a comment beside every key, from the settings' own descriptions."""

from __future__ import annotations

import json
from typing import Any

import msgspec


def lines_of(settings: msgspec.Struct, indent: int = 0, *, off: bool = False) -> str:
    """The lines of a section, each with its description; ``off``: behind a #, as what holds anyway.

    Keys without value are left out.
    """
    lines = []
    tag = type(settings).__struct_config__
    if tag.tag_field is not None and not off:
        lines.append(_line(indent, tag.tag_field, yaml_value(tag.tag), "", off))
    section = msgspec.inspect.type_info(type(settings))
    assert isinstance(section, msgspec.inspect.StructType)
    for field in section.fields:
        value = getattr(settings, field.name)
        if value is None:
            continue
        if isinstance(value, msgspec.Struct):
            lines.append(_line(indent, field.encode_name, "", "", off))
            lines.append(lines_of(value, indent + 2, off=off))
            continue
        description = _described(field.type)
        lines.append(_line(indent, field.encode_name, yaml_value(value), description, off))
    return "\n".join(lines)


def yaml_value(value: Any) -> str:
    """A value on one line, as both YAML and JSON read it back."""
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return f"[{', '.join(yaml_value(item) for item in value)}]"


def _line(indent: int, key: str, value: str, description: str, off: bool) -> str:
    text = f"{'# ' * off}{' ' * indent}{key}:{f' {value}' if value else ''}"
    return f"{text}  # {description}" if description else text


def _described(node: Any) -> str:
    if isinstance(node, msgspec.inspect.Metadata):
        own = (node.extra_json_schema or {}).get("description", "")
        return own or _described(node.type)
    if isinstance(node, msgspec.inspect.UnionType):
        return next((text for each in node.types if (text := _described(each))), "")
    return ""
