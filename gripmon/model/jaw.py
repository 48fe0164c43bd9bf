"""The jaw opening from what a robot reports: positions of joints, and reports before and after an image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

LONGEST_STEP_S = 0.1
"""Between reports farther apart than this the jaw is assumed to have moved only for this time before the later one: a
robot may report only while the jaws move.
"""


class JawError(ValueError):
    """A report that contains no jaw opening; the text says why, in one line."""


def opening_between(first: tuple[int, float], last: tuple[int, float], wanted_ns: int) -> float:
    """The opening (m) at a time between two reports, stamps (ns) with openings (m): linear, but see
    :data:`LONGEST_STEP_S`.
    """
    (first_ns, first_m), (last_ns, last_m) = first, last
    share = min((last_ns - wanted_ns) / min(last_ns - first_ns, 1e9 * LONGEST_STEP_S), 1.0)
    return last_m + share * (first_m - last_m)


class JointOpening(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the jaws are open, from the positions of joints: ``offset_m + scale · (sum of the joints)``."""

    joints: Annotated[
        tuple[str, ...],
        Meta(min_length=1, max_length=8, description="joint names in JointState; the positions of several are summed"),
    ]
    scale: Annotated[float, Meta(description="metres of opening per unit of the summed positions (m/m, or m/rad)")] = (
        1.0
    )
    offset_m: Annotated[float, Meta(description="opening where the summed positions are zero (m)")] = 0.0

    def opening_m(self, positions: Mapping[str, float]) -> float | None:
        """The opening (m); None for a message about other joints only.

        Raises :class:`JawError` for one that has some of the joints only, or a position that is not finite.
        """
        there = [name for name in self.joints if name in positions]
        if not there:
            return None
        if len(there) < len(self.joints):
            missing = ", ".join(name for name in self.joints if name not in positions)
            raise JawError(f"joint state of {', '.join(there)} without {missing}")
        opening_m = self.offset_m + self.scale * sum(positions[name] for name in self.joints)
        if not math.isfinite(opening_m):
            raise JawError(f"joint state: the position of {', '.join(self.joints)} is not finite")
        return opening_m


def positions_by_joint(names: Sequence[str], positions: Sequence[float]) -> dict[str, float]:
    """Each joint's position (m or rad; maybe NaN), empty for a message with only velocities or efforts.

    Raises :class:`JawError` for as many positions as there can't be, and for two joints of one name.
    """
    if len(positions) not in (0, len(names)):
        raise JawError(f"joint state: {len(positions)} positions of {len(names)} joints")
    if len(set(names)) != len(names):
        raise JawError("joint state: two joints have the same name")
    return dict(zip(names, map(float, positions), strict=True)) if len(positions) else {}
