"""Whether a run measured enough of its frames for its figures to mean anything."""

from __future__ import annotations

LEAST_SHARE = 0.9
"""Share of the frames (no unit) below which a run's summary begins with that: a convention, for runs of any kind."""


def too_few(measured: int, *, dropped: int, refused: int = 0, unseen: int = 0, unmeasured: int = 0) -> str:
    """A sentence if fewer than :data:`LEAST_SHARE` of all frames were measured, with the reasons, the commonest first;
    else an empty string.

    ``dropped``: passed over for lack of time; ``refused``: with an image that could not be used; ``unseen``: in which
    the gripper was not found; ``unmeasured``: either of these.  There may be no frame at all.
    """
    total = measured + dropped + refused + unseen + unmeasured
    if measured >= LEAST_SHARE * total:
        return ""
    lost = [
        (dropped, "{} dropped, because this machine was too slow"),
        (refused, "{} refused, because their image could not be used"),
        (unseen, "{} in which the gripper was not found"),
        (unmeasured, "{} in which nothing could be measured"),
    ]
    reasons = ", ".join(text.format(number) for number, text in sorted(lost, key=lambda each: -each[0]) if number)
    few = f"only {measured} of {total} frames were measured ({reasons})"
    return f"{few}: the figures mean little" if 2 * measured < total else f"{few}: the figures are of these alone"
