"""Reading a gripper file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import yaml

from gripmon.model.errors import one_line
from gripmon.model.gripper.core import Gripper
from gripmon.model.gripper.model import GripperError, GripperModel


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Keeps times, as in a provenance, as text."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def gripper_from_dict(value: Any) -> Gripper:
    """A parsed YAML document -> :class:`Gripper`.  msgspec's ValidationError for a wrong key or type."""
    return Gripper(msgspec.convert(value, GripperModel))


def load_gripper(path: Path | str) -> Gripper:
    """Read a gripper file.  OSError if it can't be read; :class:`GripperError` if it can't be used."""
    try:
        value = yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
        return gripper_from_dict(value)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise GripperError(f"not YAML: {one_line(error)}; see configs/grippers for examples") from None
    except msgspec.ValidationError as error:
        raise GripperError(str(error)) from None
