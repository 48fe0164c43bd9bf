"""An episode's transforms, reduced to one per stretch in which the camera stood still relative to the gripper."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.special import chdtrc

from gripmon.analyse.corrected import correct_table
from gripmon.analyse.correction import ChangePoint, Correction
from gripmon.analyse.vectors import to_vectors
from gripmon.calibrate.verify import CHANCE, compare_hand_eye, mean_of_one_scene
from gripmon.judge.policy import PolicySettings, past_alert_limit
from gripmon.model.geometry import to_record
from gripmon.model.records import Alert, Array, Protection, Verdict
from gripmon.record.table import FrameTable

_NUMBER = re.compile(r"\d[\d.e+-]*")
Bools = NDArray[np.bool_]


def _is(text: str) -> Meta:
    return Meta(description=text)


class Motion(msgspec.Struct, frozen=True):
    """The motion before a stretch."""

    stamp_ns: Annotated[int, _is("when the camera moved, most probably")]
    earliest_ns: Annotated[int, _is("it had not moved by then, in 95 of 100 cases")]
    latest_ns: int
    shift_m: Annotated[tuple[float, float, float], _is("of the TCP, along the camera's axes")]
    size_m: Annotated[float, _is("its length")]
    rotation_rad: Annotated[float, _is("the turn")]
    p_value: Annotated[float, _is("probability of as large a difference if it stood still")]
    cause: Annotated[str, _is("the most probable cause of the alerts on it; unknown if there is none")]


class Stretch(msgspec.Struct, frozen=True, kw_only=True):
    """Frames between two motions, and the transform that holds in all of them."""

    start_ns: int
    end_ns: int
    frames: int
    measured: Annotated[int, _is("frames with a transform of their own")]
    valid: Annotated[int, _is("frames whose transform was valid")]
    verdict: Annotated[
        str, _is("valid: it comes from valid frames; suspect: it doesn't, or is off; unknown: not measured")
    ]
    cam_T_grip: Annotated[tuple[float, ...] | None, _is("x, y, z (m), quaternion x, y, z, w; null: unknown")] = None
    covariance: Annotated[tuple[float, ...] | None, _is("36 values; a single frame's, not a mean's")] = None
    protection_m: Annotated[float | None, _is("bound on its position error in each valid frame; null: none")] = None
    protection_rad: float | None = None
    integrity_risk: Annotated[float | None, _is("probability per frame that a bound is exceeded")] = None
    crept_m: Annotated[float | None, _is("from its first half to its second; null: not beyond chance")] = None
    not_valid_ns: Annotated[tuple[tuple[int, int], ...], _is("first and last of frames in which it isn't valid")] = ()
    motion: Annotated[Motion | None, _is("null: the episode begins with it")] = None
    reasons: Annotated[str, _is("why frames weren't valid, the most frequent first")] = ""


def stretches_of(
    table: FrameTable, alerts: Sequence[tuple[int, Alert]], reasons: Sequence[str | None], policy: PolicySettings
) -> list[Stretch]:
    """The stretches of one episode, in order; ``alerts`` with their stamps (ns); ``reasons`` (n,): why frames weren't
    valid; ``policy``: with the alert limits, which bound a stretch's error as they do a frame's.

    The camera moved where the off-line smoother finds a change point and the transforms before and after it differ by
    ``verify``'s test at :data:`CHANCE`; otherwise it is one stretch.  Raises ValueError if too little was measured.
    """
    correction = correct_table(table, lambda: None)
    poses, measured = table.matrices(), ~table.refused & np.isfinite(table.cam_T_grip).all(axis=1)
    valid = measured & (table.verdict == table.VERDICTS.index(Verdict.VALID.value))
    begins: list[int] = [0]
    motions: list[Motion | None] = [None]
    for point in correction.change_points:
        motion = _motion(table, poses, valid, measured, point, begins[-1], _next(correction, point), alerts)
        if motion is not None:
            begins.append(point.index)
            motions.append(motion)
    ends = [*begins[1:], len(table)]
    return [
        _stretch(table, correction, poses, valid, measured, slice(begin, end), motion, reasons, policy)
        for begin, end, motion in zip(begins, ends, motions, strict=True)
    ]


def _next(correction: Correction, point: ChangePoint) -> int:
    later = [other.index for other in correction.change_points if other.index > point.index]
    return min(later, default=len(correction.stamp_ns))


def _used(valid: Bools, measured: Bools, part: slice) -> NDArray[np.intp]:
    """The frames from which a transform is averaged: the valid ones, or if there are none all measured ones."""
    rows = np.flatnonzero(valid[part])
    return part.start + (rows if len(rows) else np.flatnonzero(measured[part]))


def _motion(
    table: FrameTable,
    poses: Array,
    valid: Bools,
    measured: Bools,
    point: ChangePoint,
    begin: int,
    end: int,
    alerts: Sequence[tuple[int, Alert]],
) -> Motion | None:
    sides = [_used(valid, measured, slice(begin, point.index)), _used(valid, measured, slice(point.index, end))]
    if not all(len(side) for side in sides):
        return None
    (a, A), (b, B) = (mean_of_one_scene(list(poses[side]), list(table.covariance[side])) for side in sides)
    found = compare_hand_eye(a, A, b, B)
    if found.p_value >= CHANCE:
        return None
    x, y, z = found.position_m.tolist()
    around = [alert for stamp_ns, alert in alerts if point.earliest_ns <= stamp_ns <= int(table.stamp_ns[end - 1])]
    causes = [str(alert.cause) for alert in around if alert.tcp_shift_m is not None and str(alert.cause) != "unknown"]
    return Motion(
        point.stamp_ns,
        point.earliest_ns,
        point.latest_ns,
        (x, y, z),
        float(np.linalg.norm(found.position_m)),
        float(np.linalg.norm(found.rotation_rad)),
        found.p_value,
        causes[-1] if causes else "unknown",
    )


def _stretch(
    table: FrameTable,
    correction: Correction,
    poses: Array,
    valid: Bools,
    measured: Bools,
    part: slice,
    motion: Motion | None,
    reasons: Sequence[str | None],
    policy: PolicySettings,
) -> Stretch:
    # Numbers differ from frame to frame, and so does text in brackets.
    why = Counter(_NUMBER.sub("…", reason.partition(" (")[0]) for reason in reasons[part] if reason)
    counted = "; ".join(f"{count} times: {reason}" for reason, count in why.most_common(3))
    plain = {
        "start_ns": int(table.stamp_ns[part.start]), "end_ns": int(table.stamp_ns[part.stop - 1]),
        "frames": part.stop - part.start, "measured": int(measured[part].sum()), "valid": int(valid[part].sum()),
        "motion": motion, "not_valid_ns": _runs(table.stamp_ns[part], np.ones(part.stop - part.start, dtype=bool)),
    }  # fmt: skip
    used = _used(valid, measured, part)
    if not len(used):
        return Stretch(verdict=Verdict.UNKNOWN.value, reasons=counted, **plain)
    mean, covariance = mean_of_one_scene(list(poses[used]), list(table.covariance[used]))
    away = to_vectors(mean, poses[used])
    bounds = np.column_stack([
        table.protection_m[used] + np.linalg.norm(away[:, :3], axis=1),
        table.protection_rad[used] + np.linalg.norm(away[:, 3:], axis=1),
    ])  # fmt: skip
    record = to_record(mean)
    halves = [used[: (len(used) + 1) // 2], used[len(used) // 2 :]]
    (a, A), (b, B) = (
        mean_of_one_scene(list(correction.cam_T_grip[half]), list(correction.covariance[half])) for half in halves
    )
    crept = compare_hand_eye(a, A, b, B)
    moved = crept.p_value < CHANCE
    holds = valid[used] & _within(bounds, policy, all_or_none=moved)
    if holds.any():
        bounds = bounds[holds]
    elif valid[used].all():
        beyond = _past_limit(bounds.max(axis=0), policy)
        counted = "; ".join(text for text in (f"as one transform {beyond}", counted) if text)
    out = np.ones(len(table), dtype=bool)
    out[used[holds]] = False
    plain |= {"not_valid_ns": _runs(table.stamp_ns[part], out[part]), "reasons": counted}
    return Stretch(
        verdict=Verdict.VALID.value if holds.any() else Verdict.SUSPECT.value,
        cam_T_grip=(*record.translation_m, *record.rotation_xyzw),
        covariance=tuple(covariance.ravel().tolist()),
        protection_m=_largest(bounds[:, 0]),
        protection_rad=_largest(bounds[:, 1]),
        integrity_risk=_largest(table.integrity_risk[used]),
        crept_m=float(np.linalg.norm(crept.position_m)) if moved else None,
        **plain,
    )


def _within(bounds: Array, policy: PolicySettings, *, all_or_none: bool) -> Bools:
    """(n,) frames whose bounds (n, 2), m and rad, are within the alert limits.  With ``all_or_none``, for a camera that
    crept, none is unless all are: those who join frames to its one transform are told that they are several.
    """
    within = np.array([_past_limit(bound, policy) is None for bound in bounds])
    return within & (within.all() or not all_or_none)


def _past_limit(bound: Array, policy: PolicySettings) -> str | None:
    position_m, rotation_rad = bound.tolist()
    return past_alert_limit(Protection(position_m, rotation_rad, 0.0), policy)


def _runs(stamp_ns: NDArray[np.int64], chosen: Bools) -> tuple[tuple[int, int], ...]:
    """First and last stamp of each run of chosen frames."""
    changes = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return tuple(zip(stamp_ns[changes[::2]].tolist(), stamp_ns[changes[1::2] - 1].tolist(), strict=True))


def _largest(values: Array) -> float | None:
    """The largest; None if any is unknown, since there is no bound then."""
    return float(values.max()) if np.isfinite(values).all() else None


def mountings_of(
    cam_T_grip: Array,
    covariance: Array,
    level: float = 0.01,
    tolerance_m: float = 0.0,
    tolerance_rad: float = 0.0,
) -> NDArray[np.int64]:
    """The mounting (n,) of each transform (n, 4, 4) with covariances (n, 6, 6): numbers from 0, in the order of their
    first occurrence.

    The most certain transform represents its mounting: all others belong to it that ``verify``'s test can't distinguish
    from it, or that are within both tolerances; this is repeated for the rest.  A transform that agrees with several
    belongs to the first.  ``level`` is the probability that any of the n is wrongly separated from its mounting, so
    that each test has ``level / n``.
    """
    count = len(cam_T_grip)
    out = np.full(count, -1, np.int64)
    certain = np.argsort(np.linalg.slogdet(covariance)[1] if count else np.empty(0), kind="stable")
    leaders = 0
    for leader in certain.tolist():
        if out[leader] >= 0:
            continue
        left = np.flatnonzero(out < 0)
        xi = to_vectors(cam_T_grip[leader], cam_T_grip[left])
        chi2 = np.einsum(
            "ni,ni->n", xi, np.linalg.solve(covariance[leader] + covariance[left], xi[:, :, None])[:, :, 0]
        )
        near = (np.linalg.norm(xi[:, :3], axis=1) <= tolerance_m) & (np.linalg.norm(xi[:, 3:], axis=1) <= tolerance_rad)
        same = (chdtrc(6, chi2) >= level / count) | near
        out[left[same]] = leaders
        out[leader] = leaders
        leaders += 1
    _, first, inverse = np.unique(out, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse] if count else out
