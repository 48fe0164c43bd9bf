"""The motion that puts the camera back: from where the newest frame has the gripper to where a reference has it.

The gripper stands still and the camera is moved, so the reference's camera frame seen from the present one is
``cam_T_ref = cam_T_grip @ inv(ref_T_grip)``: its translation is where the lens must go, its rotation how the camera
must be turned, both in the camera's own axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from gripmon.model.geometry import from_record, invert, log_rotation, rotation_angle, to_vector
from gripmon.model.mount import DIRECTIONS, Move, afterwards, moves, summary
from gripmon.model.records import Array, CommandReply, FrameRecord, Mount, ReferenceRecord, Verdict

_MONITOR = "monitor"


class MountView(msgspec.Struct, frozen=True):
    """For a page: ``reference`` to stand at, a line of ``summary``, whether the camera is ``placed`` and whether it is
    ``known`` where it stands, the six bars, and what remains to be done ``afterwards``.
    """

    reference: str
    summary: str
    placed: bool
    known: bool
    directions: str
    rows: tuple[Move, ...]
    afterwards: str


def view_of(reply: CommandReply | None, robot: str, camera: str) -> MountView | None:
    """The same for a page; None from a monitor that doesn't say how its camera is mounted."""
    if reply is None or (mount := reply.mount) is None:
        return None
    target = f"{mount.reference_id} (revision {mount.revision})"
    known, after = mount.shift_m is not None, afterwards(reply, robot, camera)
    return MountView(target, summary(mount), mount.placed, known, DIRECTIONS, moves(mount), after)


def to_stand_at(references: Sequence[ReferenceRecord]) -> ReferenceRecord:
    """The newest reference that a configuration or an operator let in; the newest if none is.  The monitor's own ones
    are of where a knock left the camera, from which it is to be put back.
    """
    return next((one for one in reversed(references) if one.accepted_by != _MONITOR), references[-1])


def cam_T_reference(record: FrameRecord, reference: ReferenceRecord) -> Array | None:
    """Where the camera should be, seen from where it is (4, 4); None if this frame measured nothing.  A held transform
    is of before somebody moved the camera.
    """
    if not record.measured or record.cam_T_grip is None:
        return None
    return np.asarray(from_record(record.cam_T_grip) @ invert(from_record(reference.cam_T_grip)))


def mount_of(
    record: FrameRecord | None, reference: ReferenceRecord, alert_limit_m: float, alert_limit_rad: float
) -> Mount:
    """How the camera stands to the reference, as the record shows it."""
    mount = Mount(reference.reference_id, reference.revision, alert_limit_m, alert_limit_rad)
    if record is None:
        return msgspec.structs.replace(mount, reason="no frame comes")
    cam_T_ref = cam_T_reference(record, reference)
    uncertain = record.verdict is not Verdict.VALID
    reason = (record.reason or str(record.state)) if uncertain or cam_T_ref is None else ""
    if cam_T_ref is None or record.cam_T_grip is None:
        return msgspec.structs.replace(mount, reason=reason)
    tcp_m = np.array(record.cam_T_grip.translation_m)
    # A turn by w about an axis moves the TCP by w times its distance from that axis.
    levers_m = [math.hypot(*np.delete(tcp_m, axis)) for axis in range(3)]
    limits = [min(alert_limit_rad, alert_limit_m / max(lever_m, 1e-9)) for lever_m in levers_m]
    return msgspec.structs.replace(
        mount,
        reason=reason,
        shift_m=to_vector(cam_T_ref[:3, 3]),
        turn_rad=to_vector(log_rotation(cam_T_ref[:3, :3])),
        turn_limits_rad=to_vector(np.array(limits)),
        tcp_off_m=math.dist(record.cam_T_grip.translation_m, reference.cam_T_grip.translation_m),
        turned_rad=rotation_angle(cam_T_ref[:3, :3]),
    )


def at_reference(record: FrameRecord, reference: ReferenceRecord) -> Array | None:
    """``cam_T_grip`` with which the gripper's model would lie on the image, if the camera stood at the reference; None
    if this frame measured nothing.
    """
    cam_T_ref = cam_T_reference(record, reference)
    if cam_T_ref is None or record.measured_T is None:
        return None
    return np.asarray(invert(cam_T_ref) @ from_record(record.measured_T))
