"""What a measurement is worth, and what is published of a frame in which the gripper was measured."""

from __future__ import annotations

from dataclasses import dataclass

from gripmon.model.records import Array, Protection
from gripmon.monitor.refits import Anchored, Refits
from gripmon.track.edges import FingerEndsSeen, Measurement
from gripmon.track.look import Fused


@dataclass(frozen=True, slots=True)
class Trust:
    """What one measurement is worth.

    ``protection`` of the pose that was asked about; ``proven``: the fingers' ends are seen as such, or it needs none;
    ``displaced``: the pose is not where the anchor has it; ``ambiguous``: something else than a knock of the mount
    explains that, too; ``grasped``: that may be something between the fingers; ``may_have_slid``: a
    lone finger along itself, its end being seen elsewhere than it was.  ``most_probable``: the fits with the
    anchor, and the number of the most probable hypothesis; None where there is none.  ``ends``: as they were seen.
    ``fits``: what it was made of, without the ends where it needs none; None where no edge is seen.
    """

    protection: Protection
    proven: bool
    displaced: bool = False
    ambiguous: bool = False
    grasped: bool = False
    may_have_slid: bool = False
    most_probable: tuple[Anchored, int] | None = None
    ends: FingerEndsSeen | None = None
    fits: Refits | None = None

    @property
    def instead(self) -> tuple[int, Array, Array] | None:
        """Number of the most probable hypothesis, with the pose (4, 4) and covariance (6, 6) that the anchor and the
        rest of the edges give under it; None where there is none.
        """
        if self.most_probable is None or self.fits is None:
            return None
        anchored, number = self.most_probable
        return (number, *self.fits.solution(anchored, number))


@dataclass(frozen=True, slots=True)
class Standing:
    """What is published of a ``measurement``: pose (4, 4), covariance (6, 6) and ``protection``.

    ``believed``: the gripper may be taken to be there, so that averages, the drift test and what is learnt may rest on
    it; ``where_it_was``: the anchor has it there; ``grasped``: something between the fingers may have shifted their
    inner edges, and with them the opening; ``knocked``: it is there from this frame on; ``unproven``: nothing in the
    frame proves it, though something did before; ``finer``: what the gripper's look makes of it, which then is the
    pose.
    """

    measurement: Measurement
    cam_T_grip: Array
    covariance: Array
    protection: Protection
    believed: bool
    where_it_was: bool
    grasped: bool = False
    knocked: bool = False
    unproven: bool = False
    finer: Fused | None = None
