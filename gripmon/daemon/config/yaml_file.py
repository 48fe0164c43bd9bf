"""gripmon's YAML files, read as settings and written with comments."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

import gripmon
from gripmon.daemon.config.typed import ConfigError, SettingsError, to_settings
from gripmon.model.fields import described
from gripmon.model.yaml_text import YamlFault, parse_yaml, plain_value

_T = TypeVar("_T")
_LINES, _SEE = "`key: value` lines, indented with blanks", "`key: value` lines; see configs/demo.yaml"


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.  :class:`ConfigError` if unreadable, not YAML, not a mapping, or with a key twice."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(path, "", "there is no such file", "the path of a YAML file") from None
    except IsADirectoryError:
        raise ConfigError(path, "", "is a folder", "the path of a YAML file") from None
    except UnicodeDecodeError as error:
        raise ConfigError(path, "", f"is not text (byte {error.start} is not UTF-8)", "a YAML file") from None
    except OSError as error:
        raise ConfigError(path, "", f"can't be read ({error.strerror})", "a readable YAML file") from None
    try:
        value = parse_yaml(text)
    except YamlFault as fault:
        raise ConfigError(path, fault.where, fault.wrong, fault.right or (_LINES if fault.where else _SEE)) from None
    if value is None:
        raise ConfigError(path, "", "is empty", _SEE)
    if not isinstance(value, dict):
        kind = "a list" if isinstance(value, list) else f"a single value {value!r}"
        raise ConfigError(path, "", f"holds {kind}", _SEE)
    return value


def read_settings(path: Path, kind: type[_T], values: dict[str, Any] | None = None) -> _T:
    """The content of a YAML file (or ``values``, if already read) as a settings type.  :class:`ConfigError`, which
    names the type of any other gripmon file.
    """
    values = read_yaml(path) if values is None else values
    try:
        return to_settings(values, kind)
    except SettingsError as error:
        if other := _other_kind(values, kind):
            raise ConfigError(path, "", *other) from None
        raise ConfigError.of(path, error.fault) from None


_LOOKS_LIKE = {
    "edge_settings": "a taught model", "gripper": "a configuration", "points": "a gripper file",
    "corners": "a file with corners", "accepted": "the entries of gripmon setup",
}  # fmt: skip
_SCHEMAS = {
    "gripmon.camera_calibration": "a file of gripmon calibrate intrinsics",
    "gripmon.hand_eye_calibration": "a file of gripmon calibrate plane",
    "gripmon.robot_world_calibration": "a file of gripmon calibrate robot-world",
    "gripmon.laser_calibration": "a file of gripmon calibrate laser",
}
_NAMED_UNDER = {
    "a file of gripmon calibrate intrinsics": "camera", "a file of gripmon calibrate plane": "reference",
    "a gripper file": "gripper", "a taught model": "taught",
}  # fmt: skip
"""Keys of a configuration."""


def builtin_config(name: str) -> Path:
    """The path of a file in ``configs/``, in a checkout or in an installed wheel (there it lies in the package)."""
    package = Path(gripmon.__file__).resolve().parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is not among the installed configuration files")


def read_configuration(path: Path) -> dict[str, Any]:
    """The mapping in a configuration.  :class:`ConfigError`, which names the type of any other gripmon file."""
    if path.parts[:1] == ("configs",) and not path.exists():  # as examples name them, in a checkout
        with contextlib.suppress(FileNotFoundError):
            shipped = builtin_config(str(path.relative_to("configs")))
            raise ConfigError(path, "", "there is no such file", f"the one that comes with gripmon is {shipped}")
    values = read_yaml(path)
    kind = kind_of(values)
    if kind is not None and kind != "a configuration":
        right = "a configuration, such as gripmon teach writes"
        right += f"; this file belongs there under {_NAMED_UNDER[kind]}" if kind in _NAMED_UNDER else ""
        raise ConfigError(path, "", f"is {kind}", right)
    return values


def named_file(path: Path, key: str, name: str, what: str, instead: str = "") -> Path:
    """A file that a configuration names, ``what`` there would be right.  :class:`ConfigError` if there is none."""
    there, right = path.parent / name, f"{what}, its path relative to this file{instead}"
    try:
        found = there.is_file()
    except OSError as error:  # a name that is too long
        raise ConfigError(path, key, f"{name[:40]}… can't be a file ({error.strerror})", right) from None
    if not found:
        raise ConfigError(path, key, f"there is no file {there}", right)
    return there


def kind_of(values: dict[str, Any]) -> str | None:
    """The type of gripmon file, in words; None if unknown."""
    known = _SCHEMAS.get(str(values.get("schema")).partition("/")[0])
    return known or next((what for key, what in _LOOKS_LIKE.items() if key in values), None)


def _other_kind(values: dict[str, Any], wanted: type) -> tuple[str, str] | None:
    """What is wrong and what would be right, where this is another file of ours than one without ``schema``."""
    given, config = kind_of(values), getattr(wanted, "__struct_config__", None)
    if given is None or config is None or config.tag is not None:
        return None
    mark = next((key for key in _LOOKS_LIKE if key in wanted.__struct_fields__), None)  # type: ignore[attr-defined]
    return None if mark is None or mark in values else (f"is {given}", _LOOKS_LIKE[mark])


def is_document(path: Path) -> bool:
    """Whether a file has a ``schema``, as those of gripmon have."""
    with contextlib.suppress(ConfigError):
        return "schema" in read_yaml(path)
    return False


def read_document(path: Path, kind: type[_T]) -> _T:
    """The content of a file with a ``schema`` as that type.  :class:`ConfigError`."""
    values, tag = read_yaml(path), str(kind.__struct_config__.tag)  # type: ignore[attr-defined]
    schema, given, wanted = values.get("schema"), kind_of(values), _SCHEMAS[tag.partition("/")[0]]
    if schema == tag:
        return read_settings(path, kind, values)
    if given not in (None, wanted):
        raise ConfigError(path, "", f"is {given}", wanted)
    wrong = "is missing" if schema is None else f"is {schema!r}"
    raise ConfigError(path, "schema", wrong, f"schema: {tag}, {wanted}")


def lines_of(settings: msgspec.Struct, indent: int = 0, *, off: bool = False) -> str:
    """The lines of a section, each with its description; ``off``: commented out, for defaults.

    Keys without value are omitted.
    """
    lines = []
    tag = type(settings).__struct_config__
    if tag.tag_field is not None and not off:
        lines.append(_line(indent, tag.tag_field, plain_value(tag.tag), "", off))
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
        description = described(field.type)
        lines.append(_line(indent, field.encode_name, plain_value(value), description, off))
    return "\n".join(lines)


def _line(indent: int, key: str, value: str, description: str, off: bool) -> str:
    text = f"{'# ' * off}{' ' * indent}{key}:{f' {value}' if value else ''}"
    return f"{text}  # {description}" if description else text
