"""The tables of ``docs/reference/wire.md``, made from the JSON Schema of the messages."""

from __future__ import annotations

import re
from typing import Any

from gripmon.model.records import MESSAGES, json_schema
from pages import cell


def put_into(page: str) -> str:
    """The page with a table at every mark ``<!-- table: NAME -->``; KeyError for an unknown name."""
    return re.sub(r"<!-- table: (\w+) -->", lambda mark: f"{mark[0]}\n{_table(mark[1])}\n<!-- end -->", page)


def definitions() -> dict[str, Any]:
    """All types on the wire by name, messages under their own: ``transform``."""
    names = {message.__name__: name for name, message in MESSAGES.items()}
    return {names.get(title, title): node for title, node in json_schema()["$defs"].items()}


def fields_in(page: str) -> dict[str, list[str]]:
    """What a reader finds: the fields in the rows of each table."""
    return {
        name: re.findall(r"^\| `(\w+)` \|", rows, re.MULTILINE)
        for name, rows in re.findall(r"<!-- table: (\w+) -->\n(.*?)<!-- end -->", page, re.DOTALL)
    }


def words_in(page: str) -> dict[str, list[str]]:
    """The words of each enumeration."""
    return {
        name: re.findall(r"`(\w+)`", rows)
        for name, rows in re.findall(r"<!-- table: (\w+) -->\n(`.*?)<!-- end -->", page, re.DOTALL)
    }


def _table(name: str) -> str:
    node = definitions()[name]
    if "properties" not in node:
        return ", ".join(f"`{word}`" for word in _words(node))
    required = set(node.get("required", ()))
    rows = ["| field | type | meaning |", "| --- | --- | --- |"]
    for field, about in node["properties"].items():
        optional = "" if field in required else "; may be absent"
        rows.append(f"| `{field}` | {_type(about)}{optional} | {_meaning(about)} |")
    return "\n".join(rows)


def _words(node: dict[str, Any]) -> list[str]:
    return list(node.get("enum") or next(part["enum"] for part in node["anyOf"] if "enum" in part))


def _type(node: dict[str, Any]) -> str:
    if "$ref" in node:
        title = node["$ref"].rpartition("/")[2]
        names = {message.__name__: f"message `{name}`" for name, message in MESSAGES.items()}
        return names.get(title, f"`{title}`")
    if "anyOf" in node:
        return " or ".join(_type(part) for part in node["anyOf"])
    if "enum" in node:
        return ", ".join(f'`"{word}"`' for word in node["enum"])
    if node.get("type") != "array":
        return str(node["type"])
    if "prefixItems" in node:
        return f"{len(node['prefixItems'])} × {_type(node['prefixItems'][0])}"
    size = node.get("minItems")
    inner = _type(node["items"])
    return f"{size} × {inner}" if size and size == node.get("maxItems") else f"list of {inner}"


def _meaning(node: dict[str, Any]) -> str:
    """Its own description, and those of what it is made of."""
    texts = [node["description"]] if "description" in node else []
    texts += [part["description"] for part in node.get("anyOf", ()) if "description" in part]
    if not texts and "$ref" in node:
        texts = [json_schema()["$defs"][node["$ref"].rpartition("/")[2]]["description"].split("\n")[0]]
    return cell(". ".join(dict.fromkeys(text.rstrip(".") for text in texts)))
