"""Calibration targets as a command line names them, and as files record them."""

from __future__ import annotations

import shlex
from pathlib import Path

from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.errors import InputError
from gripmon.model.targets import Target, TargetError, checked, parse_target


def is_target_file(text: str) -> bool:
    """Whether this names a file instead of describing a target."""
    return text.lower().endswith((".yaml", ".yml"))


def target_of(text: str) -> Target:
    """A target as a command line has it: described, or in the file of a calibration that was made with it.

    Raises :class:`~gripmon.model.targets.TargetError`, one line.
    """
    if not is_target_file(text):
        return parse_target(text)
    right = "a file of gripmon calibrate intrinsics or plane, or one with the line target: circles:8x8:0.008:0.004"
    try:
        values = read_yaml(Path(text))
    except InputError as error:
        raise TargetError(str(error)) from None
    described = values.get("target")
    if described is None:
        made = values.get("provenance")
        described = target_of_command(made.get("command") if isinstance(made, dict) else None)
    if described is None and "kind" in values:
        described = values
    if isinstance(described, dict):
        return checked(described, text, right)
    if not isinstance(described, str) or is_target_file(described):
        raise TargetError(f"{text}: names no target; {right}")
    try:
        return parse_target(described)
    except TargetError as error:
        raise TargetError(f"{text}: {error}") from None


def target_of_command(command: object) -> str | None:
    """What a command, as a file's provenance has it, gives after ``--target``."""
    try:
        words = shlex.split(command) if isinstance(command, str) else []
    except ValueError:
        return None
    return words[words.index("--target") + 1] if "--target" in words[:-1] else None
