"""What a recording holds beside the frames' own records: about itself, its configuration, and the commands received.

Each is written as one JSON text: ``meta`` and ``configuration`` once in every file, ``command`` whenever one was
carried out.
"""

from __future__ import annotations

import base64
from typing import Annotated, Self

import msgspec

from gripmon.model.records.commands import CommandName
from gripmon.model.records.references import MonitorState


class Meta(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.recording/1"):
    """Identifies a file: the files of one run share a ``recording_id``."""

    name: Annotated[str, msgspec.Meta(description="the files' name before their number")]
    recording_id: Annotated[str, msgspec.Meta(description="the same in all files of a run, and in no other's")]
    robot: Annotated[str, msgspec.Meta(description="second part of the monitor's keys")]
    camera: Annotated[str, msgspec.Meta(description="third part of the monitor's keys")]
    gripper: Annotated[str, msgspec.Meta(description="its name in the gripper file")]
    version: Annotated[str, msgspec.Meta(description="of gripmon")]
    file_number: Annotated[int, msgspec.Meta(description="counts the files of a run")]
    started_ns: Annotated[int, msgspec.Meta(description="when this file was begun, Unix ns")]
    image_policy: Annotated[str, msgspec.Meta(description="which images are kept, and how, in words")]
    has_truth: Annotated[bool, msgspec.Meta(description="it was simulated: the TCP's true position is there, too")]
    kind: Annotated[
        str, msgspec.Meta(description="frames of a wrist camera, or spots: the laser's pulses of a second camera")
    ] = "frames"


class RecordedFile(msgspec.Struct, frozen=True):
    """A file as it was read: text, or base64 if it isn't text."""

    content: str
    base64: bool = False

    @classmethod
    def of(cls, data: bytes) -> Self:
        """A file with these bytes."""
        try:
            return cls(data.decode("utf-8"))
        except UnicodeDecodeError:
            return cls(base64.b64encode(data).decode("ascii"), base64=True)

    @property
    def data(self) -> bytes:
        """Its original bytes; ValueError for invalid base64."""
        return base64.b64decode(self.content, validate=True) if self.base64 else self.content.encode("utf-8")


class RecordedConfiguration(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.configuration/1"):
    """All that the monitor's decisions depend on besides the frames: on the same frames it decides the same."""

    main: Annotated[str, msgspec.Meta(description="the configuration's name among the files")]
    files: Annotated[
        dict[str, RecordedFile],
        msgspec.Meta(description="the configuration and what it names, by path from it; no keys or passwords"),
    ]
    start: Annotated[
        MonitorState | None, msgspec.Meta(description="what the monitor began with; null: as configured")
    ] = None


class RecordedCommand(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.recorded_command/1"):
    """A command that the monitor received, and its outcome."""

    stamp_ns: Annotated[int, msgspec.Meta(description="when it was carried out, Unix ns")]
    seq: Annotated[int, msgspec.Meta(description="of the last frame before it; -1: none yet")]
    name: CommandName
    argument: Annotated[str, msgspec.Meta(description="as it was given; may be empty")]
    done: Annotated[bool, msgspec.Meta(description="false: refused, and nothing has changed")]
    text: Annotated[str, msgspec.Meta(description="what was done, or why not, in one line for a person")]
