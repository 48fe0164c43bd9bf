"""What is published of a frame in which the gripper was measured."""

from __future__ import annotations

from dataclasses import dataclass

from gripmon.model.records import Array, Protection
from gripmon.track.edges import Measurement
from gripmon.track.look import Fused


@dataclass(frozen=True, slots=True)
class Standing:
    """What is published of a ``measurement``: pose (4, 4), covariance (6, 6) and ``protection``.

    ``believed``: the gripper may be taken to be there, so that averages, the drift test and what is learnt may rest on
    it; ``where_it_was``: the anchor has it there; ``grasped``: something between the fingers may have shifted their
    inner edges, and with them the opening; ``finer``: what the gripper's look makes of it, which then is the pose.
    """

    measurement: Measurement
    cam_T_grip: Array
    covariance: Array
    protection: Protection
    believed: bool
    where_it_was: bool
    grasped: bool = False
    finer: Fused | None = None
