"""YAML as people expect it: duplicate keys are rejected, ``1e-3`` is a number, ``on`` and ``12:30`` are text."""

from __future__ import annotations

import copy
import functools
import json
import re
from typing import Any

import yaml

_TAG = "tag:yaml.org,2002:"


class YamlFault(Exception):
    """A text that can't be parsed: ``where`` (``line 3``, or empty), what is ``wrong``, and what would be ``right`` if
    that depends on the case and not on the file.
    """

    def __init__(self, where: str, wrong: str, right: str = "") -> None:
        super().__init__(wrong)
        self.where, self.wrong, self.right = where, wrong, right


class Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Scalars by the core schema of YAML 1.2 instead of 1.1."""


Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", "~nN"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
):
    Loader.add_implicit_resolver(
        _TAG + _tag, re.compile(rf"^(?:{_pattern})$"), [*_first, ""] if _tag == "null" else list(_first)
    )


def _integer(_loader: Loader, node: yaml.ScalarNode) -> int:
    return int(node.value)  # 010 is ten, as in YAML 1.2


def _mapping(loader: Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: dict[Any, int] = {}
    for key_node, _value in node.value:
        key = loader.construct_object(key_node, deep=True)
        line = key_node.start_mark.line + 1
        if not isinstance(key, str):
            right = "a name; quotes around it if it looks like a number"
            raise YamlFault(f"line {line}", f"the key {key!r} is not text", right)
        if key in seen:
            wrong = f"the key '{key}' is there twice, first in line {seen[key]}"
            raise YamlFault(f"line {line}", wrong, "each key once")
        seen[key] = line
    return dict(loader.construct_pairs(node, deep=True))


Loader.add_constructor(_TAG + "int", _integer)
Loader.add_constructor(_TAG + "map", _mapping)


@functools.lru_cache(maxsize=8)
def _parsed(text: str) -> Any:
    """A start reads its files more than once, and parsing takes much longer than a copy."""
    return yaml.load(text, Loader)


def parse_yaml(text: str) -> Any:
    """The contents of a document.  Raises :class:`YamlFault`."""
    try:
        return copy.deepcopy(_parsed(text))
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise YamlFault(line, f"not YAML: {error.problem or error.context or 'malformed'}") from None
    except RecursionError:
        raise YamlFault("", "is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:
        raise YamlFault("", f"not YAML: {error}") from None


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """Quotes texts that this loader, or one of YAML 1.1, would not read as text."""


_Dumper.yaml_implicit_resolvers = {
    first: [*Loader.yaml_implicit_resolvers.get(first, ()), *yaml.SafeDumper.yaml_implicit_resolvers.get(first, ())]
    for first in {*Loader.yaml_implicit_resolvers, *yaml.SafeDumper.yaml_implicit_resolvers}
}


def as_yaml(value: dict[str, Any], *, inline: bool = False) -> str:
    """Text from which :func:`parse_yaml` reads the same mapping; ``inline``: lists of plain values in one line."""
    flow, width = (None, 160) if inline else (False, 120)
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=flow, width=width
    )
    return text


def in_one_line(value: Any) -> str:
    """Any plain value as YAML in one line."""
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=True, width=10**9
    )
    return text.strip().removesuffix("\n...")


def yaml_value(value: Any) -> str:
    """A value on one line that is valid in both YAML and JSON."""
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return f"[{', '.join(yaml_value(item) for item in value)}]"


def plain_value(value: Any) -> str:
    """The same, a text without quotes where YAML needs none."""
    return in_one_line(value) if type(value) is str else yaml_value(value)
