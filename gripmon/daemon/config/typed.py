"""Parsed YAML -> typed settings, with errors that a person can act on.

``msgspec`` does the conversion.  As its errors name neither the entry of a mapping nor what would be right, the first
fault is searched here along the type, using the descriptions and bounds in the settings.  pydantic wouldn't replace
this: it names the entry, but not what would be right, and would be a second model of what ``msgspec`` also encodes.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from msgspec import inspect as mi

from gripmon.model.decoding import decoder_of
from gripmon.model.errors import InputError

_T = TypeVar("_T")


class Fault(NamedTuple):
    """What is wrong at a key, and what would be right; another room's line that says both stands in ``wrong`` alone."""

    key: str
    wrong: str
    right: str


class SettingsError(InputError):
    """A value doesn't fit its settings type; ``fault`` says where and why."""

    def __init__(self, fault: Fault):
        super().__init__(f"{fault.key}: {fault.wrong}; {fault.right}")
        self.fault = fault


class ConfigError(InputError):
    """A configuration that can't be used; ``str()`` is one line ``file: key: what is wrong; what would be right``."""

    def __init__(self, path: Path | str, key: str, wrong: str, right: str = ""):
        parts = [str(path), key, f"{wrong}; {right}" if right else wrong]
        super().__init__(" ".join(": ".join(part for part in parts if part).split()))

    @classmethod
    def of(cls, path: Path, fault: Fault) -> ConfigError:
        """With what is wrong at a key of this file."""
        return cls(path, *fault)


@contextmanager
def faults_of(path: Path, prefix: str = "") -> Iterator[None]:
    """An :class:`InputError` in it is a :class:`ConfigError` of this file, at a key below ``prefix``; one that names a
    file stays as it is.
    """
    try:
        yield
    except ConfigError:
        raise
    except SettingsError as error:
        raise ConfigError(path, f"{prefix}{error.fault.key}", error.fault.wrong, error.fault.right) from None
    except InputError as error:
        raise ConfigError(path, "", f"{prefix}{error}") from None


def to_settings(value: Any, settings_type: type[_T], key: str = "") -> _T:
    """Convert parsed YAML to a settings type (a ``msgspec.Struct`` or a tagged union of them).

    Raises :class:`SettingsError` with the full dotted key (below ``key``) for an unknown, missing or wrong entry, and
    for numbers that are not finite.
    """
    decoder_of(settings_type)  # the pages convert in several threads
    node = mi.type_info(settings_type)
    fault = _find_fault(value, node, key)
    if fault is not None:
        raise SettingsError(fault)
    try:
        return msgspec.convert(value, settings_type)
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at ")
        inner = where.strip("`$.")
        raise SettingsError(Fault(_join(key, inner), text, "see the description of the section in configs/")) from None


def _find_fault(value: Any, node: mi.Type, key: str, description: str = "") -> Fault | None:
    if isinstance(node, mi.Metadata):
        extra = (node.extra_json_schema or {}).get("description", "")
        return _find_fault(value, node.type, key, extra or description)
    if isinstance(node, mi.UnionType):
        return _union_fault(value, node, key, description)
    if isinstance(node, mi.StructType):
        return _struct_fault(value, node, key, description)
    if isinstance(node, mi.DictType):
        return _dict_fault(value, node, key, description)
    if isinstance(node, mi.TupleType | mi.VarTupleType | mi.ListType):
        return _sequence_fault(value, node, key, description)
    return _leaf_fault(value, node, key, description)


def _union_fault(value: Any, node: mi.UnionType, key: str, description: str) -> Fault | None:
    options = [_unwrap(t) for t in node.types]
    if value is None and any(isinstance(t, mi.NoneType) for t in options):
        return None
    structs = [t for t in options if isinstance(t, mi.StructType)]
    if structs and (isinstance(value, dict) or len(structs) == len(options)):
        several = len(structs) > 1
        return _tagged_fault(value, structs, key) if several else _struct_fault(value, structs[0], key, description)
    faults = [_find_fault(value, t, key, description) for t in node.types if not isinstance(_unwrap(t), mi.NoneType)]
    if any(fault is None for fault in faults):
        return None
    deeper = [f for f in faults if f is not None and f.key != key]
    if deeper:
        return deeper[0]
    described = [f for f in faults if f is not None]
    return described[0] if len(described) == 1 else Fault(key, f"is {_show(value)}", _expected(node, description))


def _tagged_fault(value: Any, structs: list[mi.StructType], key: str) -> Fault | None:
    tag_field = structs[0].tag_field or "type"
    tags = [str(s.tag) for s in structs]
    if not isinstance(value, dict):
        return Fault(key, f"is {_show(value)}", f"a section with the key `{tag_field}`: {_one_of(tags)}")
    if tag_field not in value:
        return Fault(_join(key, tag_field), "is missing", _one_of(tags))
    chosen = [s for s in structs if s.tag == value[tag_field]]
    if not chosen:
        wrong = f"is {_show(value[tag_field])}{_did_you_mean(str(value[tag_field]), tags)}"
        return Fault(_join(key, tag_field), wrong, _one_of(tags))
    return _struct_fault(value, chosen[0], key, "")


def _struct_fault(value: Any, node: mi.StructType, key: str, description: str) -> Fault | None:
    names = [f.encode_name for f in node.fields]
    known = [*names, node.tag_field] if node.tag_field else names
    if not isinstance(value, dict):
        return Fault(key, f"is {_show(value)}", description or f"a section with {', '.join(known)}")
    if node.tag_field and node.tag_field in value and value[node.tag_field] != node.tag:
        return Fault(_join(key, node.tag_field), f"is {_show(value[node.tag_field])}", str(node.tag))
    for name in value:
        if name not in known:
            return Fault(_join(key, name), f"unknown key{_did_you_mean(name, known)}", f"one of {', '.join(known)}")
    for field in node.fields:
        inner_key = _join(key, field.encode_name)
        if field.encode_name in value:
            fault = _find_fault(value[field.encode_name], field.type, inner_key)
            if fault is not None:
                return _with_unit(fault, inner_key, field.encode_name, names)
        elif field.required:
            return Fault(inner_key, "is missing", _expected(field.type))
    return None


def _with_unit(fault: Fault, key: str, name: str, known: list[str]) -> Fault:
    """Suggest ``opening_m`` if the section ``opening`` is given a number."""
    longer = [each for each in known if each.startswith(f"{name}_")]
    if fault.key != key or len(longer) != 1:
        return fault
    return fault._replace(wrong=f"{fault.wrong}, did you mean '{longer[0]}'?")


def _dict_fault(value: Any, node: mi.DictType, key: str, description: str) -> Fault | None:
    if not isinstance(value, dict):
        return Fault(key, f"is {_show(value)}", description or "a section of named entries")
    faults = (_find_fault(item, node.value_type, _join(key, str(name))) for name, item in value.items())
    return next((fault for fault in faults if fault is not None), None)


def _sequence_fault(
    value: Any, node: mi.TupleType | mi.VarTupleType | mi.ListType, key: str, description: str
) -> Fault | None:
    if not isinstance(value, list):
        return Fault(key, f"is {_show(value)}", _expected(node, description))
    if isinstance(node, mi.TupleType):
        if len(value) != len(node.item_types):
            return Fault(key, f"has {len(value)} values", _expected(node, description))
        types = node.item_types
    else:
        if len(value) < (node.min_length or 0) or (node.max_length is not None and len(value) > node.max_length):
            return Fault(key, f"has {len(value)} values", _expected(node, description))
        types = (node.item_type,) * len(value)
    faults = (
        _find_fault(item, t, f"{key}[{i}]", description) for i, (item, t) in enumerate(zip(value, types, strict=True))
    )
    return next((fault for fault in faults if fault is not None), None)


def _leaf_fault(value: Any, node: mi.Type, key: str, description: str) -> Fault | None:
    if isinstance(node, mi.AnyType):
        return None
    if isinstance(value, float) and not math.isfinite(value):
        return Fault(key, f"is {value}", _expected(node, description))
    if isinstance(node, mi.EnumType | mi.LiteralType):
        values = node.values if isinstance(node, mi.LiteralType) else [member.value for member in node.cls]
        options = [str(each) for each in values]
        wrong = f"is {_show(value)}{_did_you_mean(str(value), options)}"
        return None if value in values else Fault(key, wrong, _one_of(options))
    if _fits_leaf(value, node):
        return None
    return Fault(key, f"is {_show(value)}", _expected(node, description))


_LEAVES: dict[type[mi.Type], Any] = {
    mi.BoolType: bool, mi.NoneType: None, mi.StrType: str, mi.IntType: int, mi.FloatType: float,
}  # fmt: skip
_BOUNDS = ("gt", "ge", "lt", "le", "min_length", "max_length", "pattern")


def _fits_leaf(value: Any, node: mi.Type) -> bool:
    kind = _LEAVES.get(type(node), Any)  # msgspec itself checks the rest afterwards
    bounds = msgspec.Meta(**{name: getattr(node, name, None) for name in _BOUNDS})
    try:
        msgspec.convert(value, type=Annotated[kind, bounds])
    except msgspec.ValidationError:
        return False
    return True


def _expected(node: mi.Type, description: str = "") -> str:
    """What would be right for a type, in words: kind, bounds and the settings' own description with the unit."""
    if isinstance(node, mi.Metadata):
        return _expected(node.type, (node.extra_json_schema or {}).get("description", "") or description)
    # A description with a colon of its own goes into brackets.
    suffix = "" if not description else f" ({description})" if ": " in description else f": {description}"
    if isinstance(node, mi.UnionType):
        options = [t for t in node.types if not isinstance(_unwrap(t), mi.NoneType)]
        structs = [s for s in map(_unwrap, options) if isinstance(s, mi.StructType)]
        if len(structs) > 1:
            return f"a section with `{structs[0].tag_field}`: {_one_of([str(s.tag) for s in structs])}"
        return " or ".join(dict.fromkeys(_expected(t) for t in options)) + suffix
    if isinstance(node, mi.StructType):
        return f"a section with {', '.join(f.encode_name for f in node.fields)}{suffix}"
    if isinstance(node, mi.DictType):
        return f"a section of named entries{suffix}"
    if isinstance(node, mi.TupleType):
        return f"a list of {len(node.item_types)} values, each {_expected(node.item_types[0])}{suffix}"
    if isinstance(node, mi.VarTupleType | mi.ListType):
        count = f"at least {node.min_length} values" if node.min_length else "values"
        return f"a list of {count}, each {_expected(node.item_type)}{suffix}"
    if isinstance(node, mi.LiteralType):
        return _one_of([str(v) for v in node.values]) + suffix
    if isinstance(node, mi.EnumType):
        return _one_of([str(member.value) for member in node.cls]) + suffix
    if isinstance(node, mi.IntType | mi.FloatType):
        return ("a whole number" if isinstance(node, mi.IntType) else "a number") + _bounds(node) + suffix
    names = {mi.BoolType: "true or false", mi.StrType: "text", mi.NoneType: "nothing", mi.AnyType: "a value"}
    return names.get(type(node), "a value of another type") + suffix


def _bounds(node: mi.IntType | mi.FloatType) -> str:
    limits = [(">", node.gt), (">=", node.ge), ("<", node.lt), ("<=", node.le)]
    texts = [f"{sign} {limit:g}" for sign, limit in limits if limit is not None]
    return f" {' and '.join(texts)}" if texts else ""


def _one_of(options: list[str]) -> str:
    return options[0] if len(options) == 1 else f"{', '.join(options[:-1])} or {options[-1]}"


def _did_you_mean(name: str, known: list[str]) -> str:
    longer = [candidate for candidate in known if len(name) > 1 and candidate.startswith(name)]
    close = longer or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f", did you mean '{close[0]}'?" if close else ""


def _show(value: Any) -> str:
    if value is None:
        return "empty"
    if isinstance(value, dict):
        return "a section"
    if isinstance(value, list):
        return "a list"
    text = str(value).lower() if isinstance(value, bool) else str(value)
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"'{text}'" if isinstance(value, str) else text


def _unwrap(node: mi.Type) -> mi.Type:
    return _unwrap(node.type) if isinstance(node, mi.Metadata) else node


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key and name else key or name
