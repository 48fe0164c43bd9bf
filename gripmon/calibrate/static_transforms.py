"""Transforms between two frames, as ``static_transform_publisher`` publishes them: in a line of a shell, or in a launch
file (Python, XML, YAML), such as MoveIt's.
"""

from __future__ import annotations

import ast
import contextlib
import re
import shlex
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gripmon.calibrate.foreign import Document, FileValues, InterchangeError, shown
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array

_ANGLES, QUATERNION = ("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw")
FIXED = "is a fixed camera's pose; gripmon calibrate robot-world is for those"


@dataclass(frozen=True, slots=True)
class FramePair:
    """A transform between two frames, which is read when it is asked for: a file may hold others that can't be read.
    ``camera``: which of them is the camera's, ``at_tcp``: whether the other one is at the TCP, if the file says it.
    """

    kind: str
    parent: str
    child: str
    parent_T_child: Callable[[], Array]
    camera: str | None = None
    covariance: tuple[float, ...] | None = None
    at_tcp: bool | None = None

    @property
    def frames(self) -> tuple[str, str]:
        return self.parent, self.child


_PUBLISHER = "static_transform_publisher"
_COMMENT = re.compile(r"^[ \t]*#.*?$", re.MULTILINE)
_LINE = re.compile(r"(?:^|[\s/])static_transform_publisher[ \t]+([^\n]*)", re.MULTILINE)
_SHELL = re.compile(r"\s#|\s\d>|[;&|<>]")
"""Ends a command: a comment, another command, where its output goes."""


def published_transforms(document: Document) -> Iterator[FramePair]:
    """``static_transform_publisher`` in a shell's line, or in a launch file (Python, XML, YAML), such as MoveIt's."""
    kind = "moveit" if "MoveIt" in document.text or "camera_link_broadcaster" in document.text else "static transform"
    if "EYE-TO-HAND" in document.text:
        raise InterchangeError(document.file, "", "says EYE-TO-HAND", FIXED)
    for command in _commands(document):
        try:
            words = shlex.split(command) if isinstance(command, str) else command
        except ValueError as error:
            raise InterchangeError(document.file, "", f"can't be read ({error})", _PUBLISHED) from None
        yield _command(document.file, kind, words)


def _commands(document: Document) -> Iterator[str | list[str]]:
    """The arguments of each node with this executable, whatever its name; or of each line of a shell."""
    text = document.text
    if text.lstrip().startswith("<"):
        yield from _xml_nodes(text)
        return
    nodes: Sequence[str | list[str]] = _python_nodes(text) if "Node(" in text else []
    with contextlib.suppress(InterchangeError, RecursionError):  # no YAML
        nodes = nodes or _yaml_nodes(document.content)
    lines = _LINE.findall(_COMMENT.sub("", text).replace("\\\n", " ")) if "Node(" not in text else []
    yield from nodes or [_SHELL.split(line, maxsplit=1)[0] for line in lines]


def _xml_nodes(text: str) -> list[str]:
    try:
        nodes = ElementTree.fromstring(text).iter("node")
    except ElementTree.ParseError:
        return []
    return [n.get("args", "") for n in nodes if _PUBLISHER in (n.get("exec"), n.get("executable"), n.get("type"))]


def _python_nodes(text: str) -> list[list[str]]:
    """Of a launch file in Python, which is parsed, not run: what isn't written out in it is no number."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its own escapes
            tree = ast.parse(textwrap.dedent(text))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return []
    found = []
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        named = {each.arg: each.value for each in call.keywords}
        executable = named.get("executable") or named.get("node_executable")
        if ast.unparse(call.func).endswith("Node") and _literal(executable) == _PUBLISHER:
            listed = named.get("arguments")
            found.append([_literal(each) for each in listed.elts] if isinstance(listed, ast.List | ast.Tuple) else [])
    return found


def _literal(node: ast.expr | None) -> str:
    """A text or a number as text; anything else as it is written."""
    try:
        return "" if node is None else str(ast.literal_eval(node))
    except ValueError:
        return ast.unparse(node) if node is not None else ""


def _yaml_nodes(content: Any) -> list[str]:
    parts = list(content.values()) if isinstance(content, Mapping) else content if isinstance(content, list) else []
    if isinstance(content, Mapping) and content.get("exec") == _PUBLISHER:
        return [str(content.get("args", ""))]
    return [args for part in parts for args in _yaml_nodes(part)]


_PUBLISHED = (
    "--x --y --z, --qx … --qw or --roll --pitch --yaw, --frame-id PARENT --child-frame-id CHILD; or "
    "x y z qx qy qz qw PARENT CHILD"
)
_OPTIONS = ("x", "y", "z", *QUATERNION, *_ANGLES, "frame-id", "child-frame-id")


def _command(file: str, kind: str, words: list[str]) -> FramePair:
    """By options, or by place: x y z, then yaw pitch roll or a quaternion, both frames, and ROS 1's period."""
    words = words[: words.index("--ros-args")] if "--ros-args" in words else words
    if any(word.startswith("--") for word in words):
        content = _by_options(file, words)
    else:
        words = [word for word in words if not word.startswith("__")]
        by_quaternion = len(words) > 8 and not re.match(r"[A-Za-z/_]", words[6])
        keys = ["x", "y", "z", *(QUATERNION if by_quaternion else _ANGLES[::-1]), "frame-id", "child-frame-id"]
        if len(words) > len(keys) + 1:
            wrong = f"static_transform_publisher: {shown(words[len(keys) + 1])} is more than it takes"
            raise InterchangeError(file, "", wrong, _PUBLISHED)
        content = dict(zip(keys, words, strict=False))
    values = FileValues(file, content, _PUBLISHED, "static_transform_publisher: ")
    parent, child = (str(values.value(key)).lstrip("/") for key in ("frame-id", "child-frame-id"))
    return FramePair(kind, parent, child, partial(_published_pose, values))


def _by_options(file: str, words: Sequence[str]) -> dict[str, str]:
    """Each once, as ``--x 0.1`` or ``--x=0.1``; its rotation as angles or as a quaternion."""
    content: dict[str, str] = {}
    left = iter(words)
    for word in left:
        name, equals, value = word.removeprefix("--").partition("=")
        wrong = "is no option of it" if not word.startswith("--") or name not in _OPTIONS else ""
        wrong = wrong or ("is there twice" if name in content else "")
        content[name] = value if equals else next(left, "")
        if wrong or not content[name]:
            wrong = f"static_transform_publisher: {shown(word)} {wrong or 'has no value'}"
            raise InterchangeError(file, "", wrong, _PUBLISHED)
    both = [next((name for name in names if name in content), "") for names in (_ANGLES, QUATERNION)]
    if all(both):
        wrong = f"static_transform_publisher: --{both[0]} and --{both[1]} are two rotations"
        raise InterchangeError(file, "", wrong, "angles or a quaternion")
    return content


def _published_pose(values: FileValues) -> Array:
    shift = [values.number(key, 0.0) for key in "xyz"]
    if any(key in values.content for key in _ANGLES):
        angles = [values.number(key, 0.0) for key in _ANGLES]
        return make_transform(from_angles(*angles), np.array(shift))
    return values.pose(shift, [values.number(key, float(key == "qw")) for key in QUATERNION])


def from_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation (3, 3) by angles (rad) about fixed x, y, z, as in URDF."""
    x, y, z = (exp_rotation(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True))
    return z @ y @ x
