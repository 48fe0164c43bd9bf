"""A configuration as stored in a recording: everything on which the monitor's decisions depend, so that a replay needs
no other.

Every value is stored, including defaults, so that a later version with other defaults decides the same.  The source of
images, the network, the location of the state file and the live view are omitted: decisions don't depend on them, and
some may contain passwords.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec

from gripmon.daemon.config import Config, load_config
from gripmon.daemon.config.typed import ConfigError
from gripmon.model.records import MonitorState, RecordedConfiguration, RecordedFile
from gripmon.model.yaml_text import as_yaml

_LEFT_OUT = ("source", "publish", "ros2", "state", "view")
_PLAIN_NAME = re.compile(r"[^/\\\x00]{1,255}")
_NO_SOURCE = {"kind": "folder", "path": "images-of-this-recording"}


def to_recorded(config: Config, start: MonitorState | None = None) -> RecordedConfiguration:
    """The configuration with the files that it names, under plain names; ``start``: the monitor's initial state.

    Raises :class:`ConfigError` for a file that no longer exists.
    """
    named = {"gripper": config.gripper_path, **config.calibrated.paths}
    if config.calibrated.hand_eye is None:  # a section, or a robot's file: the settings hold all that it says
        named.pop("reference", None)
    if config.taught is not None and config.taught_path is not None:
        named["taught"] = config.taught_path
    values = _plain(config)
    files: dict[str, RecordedFile] = {}
    for role, path in named.items():
        name = path.name if path.name not in (config.path.name, *files) else f"{role}-{path.name}"
        files[name] = _file(config.path, path)
        values[role] = name
    return _recorded(config.path.name, files, values, start)


def _plain(config: Config) -> dict[str, Any]:
    """The sections on which decisions depend."""
    values: dict[str, Any] = msgspec.to_builtins(config.settings)
    kept = {key: value for key, value in values.items() if key not in _LEFT_OUT and value is not None}
    return kept | {"source": _NO_SOURCE}


def _recorded(
    name: str, files: dict[str, RecordedFile], values: dict[str, Any], start: MonitorState | None = None
) -> RecordedConfiguration:
    return RecordedConfiguration(name, {**files, name: RecordedFile.of(as_yaml(values).encode())}, start)


def from_recorded(recorded: RecordedConfiguration, folder: Path) -> Config:
    """Write the files into ``folder``, which is empty, and load them as any configuration.

    Raises :class:`ConfigError` for a configuration that this version can't use, and OSError.
    """
    for name, file in recorded.files.items():
        path = folder / name
        if not _PLAIN_NAME.fullmatch(name) or name in (".", ".."):  # a recording may come from an untrusted source
            raise ConfigError(folder, "", f"the recorded configuration has a file {name!r}", "a plain name")
        try:
            path.write_bytes(file.data)
        except ValueError:
            raise ConfigError(path, "", "the recorded file is damaged", "base64") from None
    if recorded.main not in recorded.files:
        raise ConfigError(folder, "", f"the recorded configuration lacks its file {recorded.main!r}", "all its files")
    return load_config(folder / recorded.main, check_source=False, say_gone=False)


def _file(config_path: Path, path: Path) -> RecordedFile:
    try:
        return RecordedFile.of(path.read_bytes())
    except OSError as error:
        raise ConfigError(config_path, "", f"{path}: can't be read any more ({error.strerror})") from None
