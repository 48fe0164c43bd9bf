"""The commands to a running monitor, and its answers."""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.records.frames import FrameRecord, FrameRecord1
from gripmon.model.records.references import MonitorState
from gripmon.model.records.values import OpenEnum


class CommandName(enum.StrEnum):
    """A command that an operator may send to a running monitor."""

    RECALIBRATE = "recalibrate"
    ACCEPT = "accept"
    REJECT = "reject"
    UNDO = "undo"
    RESET = "reset"
    ACKNOWLEDGE = "acknowledge"
    STATE = "state"
    SNAPSHOT = "snapshot"


class Command(msgspec.Struct, frozen=True):
    """``argument``: for ``undo`` the reference to go back to (empty: the previous one), for ``accept`` and ``reject``
    the proposal (empty: the current one), for ``acknowledge`` the alert (empty: all open ones).
    """

    name: CommandName
    argument: str = ""


def accepting(reference_id: str, robot: str, camera: str) -> str:
    """The command that an operator types to accept a proposed reference."""
    return f"gripmon send accept {reference_id} --robot {robot} --camera {camera}"


_PRINTED = r"^[^\x00-\x1f\x7f]*(?![\s\S])"  # it appears in logs and on terminals: no control characters


class CommandRequest(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="schema", tag="gripmon.command/1"
):
    """The payload of a command; no payload means an empty argument.

    The command's name is the last part of the key.  The monitor refuses a field that it doesn't know: it must not carry
    out what it can't honour.
    """

    argument: Annotated[
        str,
        Meta(
            max_length=256,
            pattern=_PRINTED,
            description="the reference, proposal or alert that is meant; empty: see the command",
        ),
    ] = ""
    id: Annotated[
        str,
        Meta(
            max_length=64,
            pattern=_PRINTED,
            description="of this request: sent again, it gets the same answer and isn't carried out again; empty: none",
        ),
    ] = ""
    monitor_id: Annotated[
        str,
        Meta(
            max_length=64,
            pattern=_PRINTED,
            description="the start of the monitor that is meant, any other refuses; empty: the only one of its name",
        ),
    ] = ""


class SnapshotImage(msgspec.Struct, frozen=True):
    """The image of a snapshot; the file itself is attached to the reply."""

    encoding: Annotated[str, Meta(description="png, which loses nothing, or jpeg for more than 32 MiB of pixels")]
    width_px: Annotated[int, Meta(description="columns")]
    height_px: Annotated[int, Meta(description="rows")]
    pixels: Annotated[str, Meta(description="mono8, mono16, bgr8 or bgr16 as decoded by OpenCV; float images: 16 bit")]
    size_bytes: Annotated[int, Meta(description="of the attachment")]


Outlines = tuple[tuple[tuple[float, float], ...], ...]
"""Lines in an image, each given by its points (u, v), px."""


Three = tuple[float, float, float]


class Mount(msgspec.Struct, frozen=True):
    """How the camera must be moved to stand against the gripper as at a reference: the newest that a person let in, so
    not one that the monitor made itself after a knock.

    All axes are the camera's own, where it stands now: x right and y down in its picture, z where it looks.
    """

    reference_id: Annotated[str, Meta(description="the reference to stand at; it may not be the one in force")]
    revision: Annotated[int, Meta(description="of that reference")]
    alert_limit_m: Annotated[float, Meta(description="largest distance of the TCP from its place at the reference, m")]
    alert_limit_rad: Annotated[float, Meta(description="largest turn against the reference, rad")]
    reason: Annotated[
        str, Meta(description="why nothing is known, or why what is known isn't certain; empty if the frame is valid")
    ] = ""
    shift_m: Annotated[
        Three | None, Meta(description="by how much the lens must be shifted, m; null if the frame has no measurement")
    ] = None
    turn_rad: Annotated[
        Three | None, Meta(description="by how much the camera must be turned about its lens: a rotation vector, rad")
    ] = None
    turn_limits_rad: Annotated[
        Three | None,
        Meta(description="turn about each axis alone that moves the TCP or the view by the alert limit, rad"),
    ] = None
    tcp_off_m: Annotated[
        float | None, Meta(description="distance of the TCP from its place at the reference, in the camera frame, m")
    ] = None
    turned_rad: Annotated[float | None, Meta(description="angle of the whole turn, rad")] = None

    @property
    def within(self) -> bool:
        """Whether both limits are kept."""
        if self.tcp_off_m is None or self.turned_rad is None:
            return False
        return self.tcp_off_m <= self.alert_limit_m and self.turned_rad <= self.alert_limit_rad

    @property
    def placed(self) -> bool:
        """Whether both limits are kept for certain: the camera stands as at the reference."""
        return self.within and not self.reason


class Snapshot(msgspec.Struct, frozen=True):
    """The newest frame: the monitor's record of it, and its image."""

    record: Annotated[FrameRecord, Meta(description="the transform message of that frame")]
    age_s: Annotated[float, Meta(description="from when it was judged to when it was asked for, s")]
    jaw_reported_m: Annotated[
        float | None, Meta(description="the opening that the robot had reported, m; null if none")
    ]
    image: Annotated[SnapshotImage | None, Meta(description="null if the frame has none that can be kept")]
    outlines_px: Annotated[
        Outlines,
        Meta(description="the gripper's visible edges where the record's transform has them, each through its points"),
    ] = ()
    reference_px: Annotated[
        Outlines,
        Meta(description="and where they would be if the camera stood as at the reference of mount; empty if unknown"),
    ] = ()


class CommandReply(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.reply/2"):
    """The monitor's answer to a command."""

    name: CommandName
    done: Annotated[bool, Meta(description="false: refused, and nothing has changed")]
    text: Annotated[str, Meta(description="what was done, or why not, in one line for a person")]
    reference_id: Annotated[str, Meta(description="the reference in force afterwards")]
    revision: Annotated[int, Meta(description="of the reference in force afterwards")]
    monitor: Annotated[
        MonitorState | None,
        Meta(
            description="answers state and snapshot: references, a proposal, open alerts, by which commands name them; "
            "else null"
        ),
    ] = None
    snapshot: Annotated[Snapshot | None, Meta(description="answers snapshot; else null")] = None
    durable: Annotated[
        bool,
        Meta(
            description="false: what was done isn't on the disk yet, and a crash would forget it; text says why. A new "
            "reference is on the disk or not in force. Without a state file nothing outlives the process, true all the "
            "same"
        ),
    ] = True
    monitor_id: Annotated[str, Meta(description="of the start that answers; empty from a monitor before ids")] = ""
    mount: Annotated[
        Mount | None,
        Meta(description="answers state and snapshot: how the camera stands to a reference; null from before it did"),
    ] = None


class Snapshot1(Snapshot, frozen=True):
    """A snapshot of an earlier version."""

    record: FrameRecord1


class CommandReply1(CommandReply, frozen=True, tag_field="schema", tag="gripmon.reply/1"):
    """A reply of an earlier version, whose snapshot has a transform of that."""

    snapshot: Snapshot1 | None = None

    def upgraded(self) -> CommandReply:
        """As of this version."""
        fields, snapshot = {name: getattr(self, name) for name in self.__struct_fields__}, self.snapshot
        if snapshot is not None:
            of_snapshot = {name: getattr(snapshot, name) for name in snapshot.__struct_fields__}
            fields["snapshot"] = Snapshot(**of_snapshot | {"record": snapshot.record.upgraded()})
        return CommandReply(**fields)


class CommandFault(OpenEnum):
    """Why a command did not reach the monitor, or why its outcome is unknown."""

    UNKNOWN = "unknown_command"
    MALFORMED = "malformed"
    SEVERAL = "several_monitors"
    ANOTHER = "another_monitor"
    BUSY = "busy"
    TIMEOUT = "timeout"
    STOPPING = "stopping"
    ID_REUSED = "id_reused"
    INTERNAL = "internal_error"


class CommandError(msgspec.Struct, frozen=True, tag_field="schema", tag="gripmon.error/1"):
    """In place of a reply: the command was not carried out, or may have been; the text says which."""

    error: CommandFault
    text: Annotated[str, Meta(description="what went wrong, in one line for a person")]
    monitor_id: Annotated[str, Meta(description="of the start that answers; empty from a monitor before ids")] = ""
