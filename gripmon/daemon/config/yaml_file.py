"""gripmon's YAML files, read as settings and written with comments."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

import gripmon
from gripmon.calibrate.foreign import Document, InterchangeError
from gripmon.daemon.config.typed import ConfigError, SettingsError, to_settings
from gripmon.model.errors import InputError
from gripmon.model.fields import described
from gripmon.model.images import LARGEST_BYTES
from gripmon.model.provenance import InputFile
from gripmon.model.yaml_text import YamlFault, parse_yaml, plain_value

_T = TypeVar("_T")
_LINES, _SEE = "`key: value` lines, indented with blanks", "`key: value` lines; see configs/demo.yaml"


class GivenFile:
    """A file that an option or a key names, which may be gripmon's or another program's: read once, parsed once.
    ``right``: what it should be.  :class:`ConfigError` where it is asked for something that it hasn't.
    """

    def __init__(self, path: Path, right: str = "the path of a YAML file") -> None:
        self.path, self._right = path, right

    def __fspath__(self) -> str:
        return str(self.path)

    @functools.cached_property
    def data(self) -> bytes:
        """Its bytes."""
        try:
            if self.path.is_file() and self.path.stat().st_size > LARGEST_BYTES:
                raise ConfigError(self.path, "", "is larger than 1 GB", self._right)
            return self.path.read_bytes()
        except FileNotFoundError:
            raise ConfigError(self.path, "", "there is no such file", self._right) from None
        except IsADirectoryError:
            raise ConfigError(self.path, "", "is a folder", self._right) from None
        except OSError as error:
            raise ConfigError(self.path, "", f"can't be read ({error.strerror})", self._right) from None

    @functools.cached_property
    def document(self) -> Document:
        """The same for readers of other programs' files."""
        return Document(str(self.path), self.data)

    @property
    def own(self) -> bool:
        """Whether it has a ``schema``, as files of gripmon's have."""
        return self._has("schema")

    @property
    def lens(self) -> dict[str, Any] | None:
        """The values of a camera as a configuration has it, in its section ``camera`` or without that name; None if it
        holds no such camera, or more than that.
        """
        if self.own:
            return None
        if self._has("fx_px"):
            return self.values
        section = self.values.get("camera") if self._has("camera") else None
        alone = isinstance(section, dict) and "fx_px" in section and len(self.values) == 1
        return section if alone else None

    def _has(self, key: str) -> bool:
        with contextlib.suppress(InputError):
            return key in self.document.content
        return False

    @property
    def values(self) -> dict[str, Any]:
        """The mapping in YAML."""
        try:
            return _mapping(self.path, self.document.text)
        except InterchangeError as error:
            raise ConfigError("", "", str(error)) from None

    @property
    def input(self) -> InputFile:
        """For the provenance of what is made of it."""
        return InputFile(file=str(self.path), sha256=hashlib.sha256(self.data).hexdigest())


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.  :class:`ConfigError` if unreadable, not YAML, not a mapping, or with a key twice."""
    return GivenFile(path).values


def _mapping(path: Path, text: str) -> dict[str, Any]:
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


def read_configuration(path: Path, text: str | None = None) -> dict[str, Any]:
    """The mapping in a configuration, or in what it will hold.  :class:`ConfigError`, which names the type of any other
    gripmon file.
    """
    if path.parts[:1] == ("configs",) and not path.exists():  # as examples name them, in a checkout
        with contextlib.suppress(FileNotFoundError):
            shipped = builtin_config(str(path.relative_to("configs")))
            raise ConfigError(path, "", "there is no such file", f"the one that comes with gripmon is {shipped}")
    values = read_yaml(path) if text is None else _mapping(path, text)
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


def read_document(file: Path | GivenFile, kind: type[_T]) -> _T:
    """The content of a file with a ``schema`` as that type.  :class:`ConfigError`."""
    file = file if isinstance(file, GivenFile) else GivenFile(file)
    path, values, tag = file.path, file.values, str(kind.__struct_config__.tag)  # type: ignore[attr-defined]
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
