"""What the fields of a message are called, measured in and mean, as the message itself says.

Parquet's columns, Prometheus's metrics and the reference page follow from it.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import msgspec
import msgspec.inspect as kinds

_UNITS = (("_m_per_min", "m/min"), ("_per_s", "1/s"), ("_rad", "rad"), ("_px", "px"), ("_ns", "ns"), ("_m", "m"),
          ("_s", "s"))  # fmt: skip


class Field(NamedTuple):
    """``unit``: by the name's ending, "1" for other numbers, empty for what is no number; ``type``: without its bounds
    and without None.
    """

    name: str
    unit: str
    help: str
    type: kinds.Type

    @property
    def stem(self) -> str:
        """The name without its unit."""
        return next((self.name.removesuffix(suffix) for suffix, unit in _UNITS if unit == self.unit), self.name)


@functools.cache
def fields_of(message: type[msgspec.Struct]) -> dict[str, Field]:
    """A message's fields by name, in their order."""
    found = kinds.type_info(message)
    assert isinstance(found, kinds.StructType)
    return {field.name: _field(field.name, field.type) for field in found.fields}


def plain(kind: kinds.Type) -> kinds.Type:
    """A type without its bounds and without None."""
    if isinstance(kind, kinds.Metadata):
        return plain(kind.type)
    if isinstance(kind, kinds.UnionType):
        return plain(next(one for one in kind.types if not isinstance(one, kinds.NoneType)))
    return kind


def described(kind: kinds.Type) -> str:
    """A type's description; ``float | None`` may hold it below the union."""
    if isinstance(kind, kinds.Metadata):
        return (kind.extra_json_schema or {}).get("description", "") or described(kind.type)
    if isinstance(kind, kinds.UnionType):
        return next((text for each in kind.types if (text := described(each))), "")
    return ""


def _field(name: str, kind: kinds.Type) -> Field:
    bare = plain(kind)
    counts = isinstance(bare, kinds.IntType | kinds.FloatType | kinds.TupleType | kinds.VarTupleType)
    unit = next((unit for suffix, unit in _UNITS if name.endswith(suffix)), "1" if counts else "")
    return Field(name, unit, described(kind) or _first_line(bare), bare)


def _first_line(kind: kinds.Type) -> str:
    """What a type says of itself."""
    text: str = getattr(kind, "cls", type(kind)).__doc__ or ""
    return text.partition("\n")[0].replace("``", "")
