"""How far a measurement can be trusted, and what is published of a frame in which the gripper was measured."""

from __future__ import annotations

from typing import NamedTuple

from gripmon.model.records import Array, ReferenceRecord
from gripmon.monitor.refits import Anchored, Refits
from gripmon.monitor.since import Bounds
from gripmon.track.edges import FingerEndsSeen, Measurement


class Trust(NamedTuple):
    """How far one measurement can be trusted.

    ``bounds``: of the pose in question.  ``proven``: the fingers' ends are seen as ends, or aren't needed.
    ``displaced``: the pose is not where the anchor has it; ``knock`` (6, 6): covariance of the motion by a knock, None
    where no edge is seen.  ``ambiguous``: something other than a knock of the mount may explain that; ``grasped``: an
    object between the fingers may.  ``may_have_slid``: a lone finger may have moved along itself unnoticed.
    ``most_probable``: the fits with the anchor, and the number of the most probable hypothesis; None where all are
    excluded.  ``ends``: as they were seen.  ``fits``: those behind the bound, without the ends where they aren't
    needed; None where no edge is seen.  ``misread``: probability that what looks like the fingers' ends is something
    else.
    """

    bounds: Bounds
    proven: bool
    displaced: bool = False
    knock: Array | None = None
    ambiguous: bool = False
    grasped: bool = False
    may_have_slid: bool = False
    most_probable: tuple[Anchored, int] | None = None
    ends: FingerEndsSeen | None = None
    fits: Refits | None = None
    misread: float = 1.0

    @property
    def instead(self) -> tuple[int, Array, Array] | None:
        """Number of the most probable hypothesis, with the pose (4, 4) and covariance (6, 6) that the anchor and the
        kept edges give under it; None where all are excluded.
        """
        if self.most_probable is None or self.fits is None:
            return None
        anchored, number = self.most_probable
        return (number, *self.fits.solution(anchored, number))


class Standing(NamedTuple):
    """What is known by a ``measurement``: the measured pose (4, 4), its covariance (6, 6) and ``bounds``.

    ``believed``: averages, the drift test and learning use the pose.
    ``where_it_was``: the anchor has it there.  ``grasped``: an object between the fingers may have shifted their inner
    edges, and with them the opening.  ``knocked``: from this frame on the mount counts as knocked.  ``unproven``:
    nothing in the frame proves the pose, though an earlier frame proved one.  ``old``: beside an edge there are only
    pixels of an earlier frame.
    """

    measurement: Measurement
    cam_T_grip: Array
    covariance: Array
    bounds: Bounds
    believed: bool
    where_it_was: bool
    grasped: bool = False
    knocked: bool = False
    unproven: bool = False
    old: bool = False


class Question(NamedTuple):
    """Whether the mount was knocked before the start, or the gripper file, the taught edges or the reference are wrong:
    the first frames showed the gripper ``away`` (6,) from where it was expected, m and rad, at a ``revision`` of the
    reference.  An operator who accepts a new reference, ``answered`` with its revision, says that it was a knock.
    """

    away: Array
    revision: int
    answered: int | None = None

    def open_at(self, revision: int) -> bool:
        """Whether it is open with the reference of a revision: with those from the answer on it isn't."""
        return self.answered is None or revision < self.answered

    def with_reference(self, reference: ReferenceRecord) -> Question:
        """The question once a reference is in force."""
        answers = reference.accepted_by == "operator" and reference.revision > self.revision
        return self._replace(answered=reference.revision) if self.answered is None and answers else self
