"""What a frame was judged by, beside the decision itself: for recordings and for display."""

from __future__ import annotations

import msgspec

SixNumbers = tuple[float, float, float, float, float, float]
"""Along the camera's x, y, z (m), then about them (rad)."""


class Limits(msgspec.Struct, frozen=True, array_like=True):
    """The limits in force, and the noise that the stream has shown; changes slowly.

    ``warn_m``, ``warn_rad``, ``limit_m`` and ``limit_rad`` are the policy's, ``tolerated`` the shift that the drift
    test always ignores.  ``noticed``: shifts that would be detected, each alone on its axis, if all frames that the
    test now rests on had them, counted from ``offset``, the part of the shift that the reference's own error explains.
    ``scatter``: learned standard deviations of frames about their mean.  ``average_share``: share of the frames'
    variance that the smoothed transform has seen as scatter, ``average_walk`` how far it assumes the mount to wander in
    a second.  ``alert_limit_m``, ``alert_limit_rad``: what the bounds on a transform's error are compared with.  None
    means unknown.
    """

    warn_m: float
    warn_rad: float
    limit_m: float
    limit_rad: float
    tolerated: SixNumbers
    noticed: SixNumbers | None
    offset: SixNumbers | None
    scatter: SixNumbers | None
    average_share: SixNumbers
    average_walk: SixNumbers
    alert_limit_m: float | None = None
    alert_limit_rad: float | None = None


class MonitorNotes(msgspec.Struct, frozen=True, array_like=True):
    """For one frame: the drift test's largest statistic over its threshold, 1 where it alarms (None: the frame wasn't
    tested), and the limits that were in force.
    """

    statistic_share: float | None
    limits: Limits
