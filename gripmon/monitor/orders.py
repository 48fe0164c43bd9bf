"""What an operator tells the monitor, carried out between two frames."""

from __future__ import annotations

from dataclasses import dataclass

from gripmon.judge.policy import Policy
from gripmon.judge.references import CommandRefused
from gripmon.model.records import Alert, Array, Command, CommandName
from gripmon.monitor.renewal import Renewal


@dataclass(frozen=True, slots=True)
class Moment:
    """Where the camera is (``cam_T_grip``, 4 x 4), whether the newest frame shows the gripper, and when: by the frames'
    time and by the wall clock.
    """

    cam_T_grip: Array
    measurable: bool
    now_s: float
    stamp_ns: int


def obey(command: Command, policy: Policy, renewal: Renewal, moment: Moment) -> tuple[str, tuple[Alert, ...]]:
    """What was done, in words, and the alerts of it.

    Raises :class:`gripmon.judge.references.CommandRefused`, and nothing has changed then.
    """
    name, reference = command.name, renewal.book.current
    if name in (CommandName.STATE, CommandName.SNAPSHOT):
        return f"{policy.state}, {reference.reference_id} in force, revision {reference.revision}", ()
    if name is CommandName.ACKNOWLEDGE:
        seen = policy.alerts.acknowledge(command.argument)
        if not seen:
            which = f"no open alert {command.argument}" if command.argument else "no open alert"
            raise CommandRefused(f"{which} that isn't acknowledged")
        return "acknowledged: " + ", ".join(alert.alert_id for alert in seen), seen
    if name is not CommandName.RECALIBRATE:
        return renewal.obey(command, moment.cam_T_grip, moment.now_s, moment.stamp_ns)
    if not moment.measurable:
        raise CommandRefused("nothing was measured in the newest frame")
    return renewal.want(), ()
