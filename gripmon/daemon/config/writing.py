"""A configuration that is written: complete, with a comment at every key, from the settings' own descriptions.

Written line by line: a YAML library that keeps comments (ruamel.yaml) would be one more dependency, and can't write
defaults as commented-out lines.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from gripmon import __version__
from gripmon.daemon.config import Config, load_config
from gripmon.daemon.config.settings import ReferenceSettings, Settings, TransformSettings
from gripmon.daemon.config.yaml_file import lines_of
from gripmon.model.atomic import write_atomically, writing
from gripmon.model.fields import described
from gripmon.model.records import Transform
from gripmon.model.yaml_text import plain_value
from gripmon.monitor import MonitorSettings

_UNITS = """\
# Lengths in metres, angles in radians, times in seconds, image coordinates in pixels (the first one's centre: 0, 0)."""
_FILES = {
    "camera": "file of gripmon calibrate intrinsics, relative to this file; or a section",
    "reference": "file of gripmon calibrate plane, relative to this file; or a section",
}
_DEFAULTS = ("monitor", "publish", "ros2", "recording", "metrics", "daemon", "state")


def text_of(command: str, **sections: Any) -> str:
    """A file that ``command`` writes: for each key of the settings its value, the path of a file that says it, or
    settings as a section; None is left out.
    """
    lines = [f"# Written by: {command} (gripmon {__version__})", _UNITS]
    kinds = msgspec.inspect.type_info(Settings)
    assert isinstance(kinds, msgspec.inspect.StructType)
    for field in kinds.fields:
        value = sections.get(field.name)
        if isinstance(value, msgspec.Struct):
            lines += [f"{field.name}:", lines_of(value, 2)]
        elif value is not None:
            lines.append(f"{field.name}: {plain_value(value)}  # {_FILES.get(field.name) or described(field.type)}")
    return "\n".join(lines) + "\n"


def reference_section(transform: Transform, **known: Any) -> ReferenceSettings:
    """A reference as a section; ``known``: its other keys."""
    pose = TransformSettings(translation_m=transform.translation_m, rotation_xyzw=transform.rotation_xyzw)
    return ReferenceSettings(cam_T_grip=pose, **known)


def defaults(monitor: MonitorSettings, *taken: tuple[str, ...]) -> str:
    """The sections that every configuration may have, commented out but for the keys of ``monitor`` that are
    ``taken``, by their paths.
    """
    lines = [
        "# Everything below holds as it stands; to change a value, take away the # before it and before what it is in."
    ]
    for field in msgspec.structs.fields(Settings):
        if field.name in _DEFAULTS:
            value = monitor if field.name == "monitor" else field.default
            section = [f"# {field.name}:", *lines_of(value, 2, off=True).splitlines()]
            for path in taken if value is monitor else ():
                section = _on(section, path)
            lines += section
    return "\n".join(lines) + "\n"


def _on(section: Sequence[str], keys: Sequence[str]) -> list[str]:
    """A section that is commented out with the key at this path taken back in."""
    out, level = list(section), 0
    for number, line in enumerate(section):
        if line.removeprefix("# ").startswith(f"{'  ' * level}{('monitor', *keys)[level]}:"):
            out[number], level = line.removeprefix("# "), level + 1
            if level > len(keys):
                break
    return out


def with_taught(path: Path, taught: Path) -> str:
    """A configuration's text with an additional line that names the taught model."""
    text, name = path.read_text(encoding="utf-8-sig"), relative(taught, path.parent)
    return f"{text.rstrip()}\n\ntaught: {plain_value(name)}  # what the edges really look like; relative to this file\n"


def name_taught(config: Config, taught: Path) -> Config:
    """Add that line to a configuration, unless it has one; returns the new configuration.

    Raises :class:`~gripmon.model.errors.InputError` where it can't be written.
    """
    if config.taught_path is None:
        with writing(config.path):
            write_atomically(config.path, with_taught(config.path, taught).encode())
    return load_config(config.path, check_source=False)


def relative(path: Path, folder: Path) -> str:
    """A path as a file in ``folder`` names it."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
