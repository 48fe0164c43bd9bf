"""An episode's transforms, reduced to one for each stretch in which the camera stood still relative to the gripper."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.analyse.corrected import correct_table
from gripmon.analyse.correction import ChangePoint
from gripmon.analyse.vectors import to_vectors
from gripmon.analyse.words import often
from gripmon.calibrate.verify import CHANCE, HandEyeDifference, compare_hand_eye, mean_of_one_scene
from gripmon.judge.policy import PolicySettings, past_alert_limit
from gripmon.model.geometry import to_record
from gripmon.model.lerobot_columns import POSE_NAMES
from gripmon.model.records import Alert, Array, Protection, ValidBy, Verdict
from gripmon.model.units import in_mm
from gripmon.record.table import COLUMNS, FrameTable, pose_matrices

_NUMBER = re.compile(r"\d[\d.e+-]*")
POSE_COLUMNS = tuple(f"cam_T_grip_{name}" for name in POSE_NAMES)
Bools = NDArray[np.bool_]
Number = float | None
Integer = int | None
Text = str | None
Numbers = tuple[float, ...] | None
Runs = tuple[tuple[int, int], ...] | None


def _is(text: str, *columns: str) -> Meta:
    """Description of a field; ``columns``: it is a tuple with one of the table's columns for each number."""
    return Meta(description=text, extra={"columns": columns})


class Stretch(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the table: the frames between two motions of the camera and the transform that holds in all of them; or,
    with ``verdict`` unknown and ``reason``, an episode of which nothing is known.
    """

    camera: Annotated[str, _is("topic, feature, or the configuration's name")] = ""
    episode: Annotated[str, _is("path below the dataset; of LeRobot with # and its number")] = ""
    stretch: Annotated[int, _is("0, 1, … in order of time; each motion begins another")] = 0
    verdict: Annotated[str, _is("valid: use the transform; suspect, unknown: don't")] = Verdict.UNKNOWN.value
    mounting: Annotated[Integer, _is("what has the same number (and camera) shares a mounting; null: not known")] = None
    start_ns: Annotated[Integer, _is("first frame's stamp (ns; of LeRobot from the episode's beginning)")] = None
    end_ns: Annotated[Integer, _is("last frame's stamp (ns)")] = None
    frames: Annotated[int, _is("in the stretch")] = 0
    measured_share: Annotated[Number, _is("of its frames with a transform of their own, 0 to 1")] = None
    valid_share: Annotated[Number, _is("of its frames whose transform was valid, 0 to 1")] = None
    cam_T_grip: Annotated[Numbers, _is("gripper to camera coordinates, as measured; null: none", *POSE_COLUMNS)] = None
    covariance: Annotated[Numbers, _is("6 x 6 by rows, position (m) then rotation (rad), camera axes")] = None
    valid_by: Annotated[Text, _is("which error protection bounds: absolute; reference, of the motion since it")] = None
    protection_m: Annotated[Number, _is("bound on the position error in each valid frame of it; null: none")] = None
    protection_rad: Annotated[Number, _is("bound on the rotation error")] = None
    integrity_risk: Annotated[Number, _is(COLUMNS["integrity_risk"].help)] = None
    since_reference_m: Annotated[Number, _is("bound on the position error of the motion since since_ns")] = None
    since_reference_rad: Annotated[Number, _is("bound on its rotation error")] = None
    since: Annotated[Text, _is("what that counts from, in this episode: reference, or first_proved frames")] = None
    since_ns: Annotated[Integer, _is("stamp of these frames; null: not known")] = None
    absolute_m: Annotated[Number, _is("bound on the position error with what is wrong in every episode alike")] = None
    absolute_rad: Annotated[Number, _is("bound on the rotation error, likewise")] = None
    moved: Annotated[bool | None, _is("the camera moved within this episode, at once or slowly")] = None
    crept_m: Annotated[Number, _is("from its first half to its second, on average; null: not beyond chance")] = None
    not_valid_ns: Annotated[Runs, _is("first and last stamp of each run of frames in which it isn't valid")] = None
    motion_ns: Annotated[Integer, _is("when the camera moved, before this stretch; null: it is the first")] = None
    motion_earliest_ns: Annotated[Integer, _is("it had not moved by then, in 95 of 100 cases")] = None
    motion_latest_ns: Annotated[Integer, _is("it had moved by then")] = None
    motion_m: Annotated[Number, _is("how far the TCP moved")] = None
    motion_xyz_m: Annotated[Numbers, _is("along the camera's axes", *(f"motion_{axis}_m" for axis in "xyz"))] = None
    motion_rad: Annotated[Number, _is("its turn")] = None
    motion_p_value: Annotated[Number, _is("probability of as large a difference by chance")] = None
    motion_cause: Annotated[Text, _is("most probable cause by the alerts; unknown: none is probable enough")] = None
    own_reference: Annotated[bool, _is("recalibrated from this episode; false: against the configuration's")] = False
    lens: Annotated[str, _is("whose camera calibration: file or configuration")] = "configuration"
    gripper: Annotated[Text, _is("gripper file by which it was measured; null: none")] = None
    reason: Annotated[Text, _is("why there is no transform, or why frames weren't valid")] = None
    picture: Annotated[bytes | None, _is("JPEG with what was measured; null: none")] = None


def stretches_of(
    table: FrameTable, alerts: Sequence[tuple[int, Alert]], reasons: Sequence[str | None], policy: PolicySettings
) -> list[Stretch]:
    """The stretches of one episode, in order; ``alerts`` with their stamps (ns); ``reasons`` (n,): why frames weren't
    valid; ``policy``: with the alert limits, which bound a stretch's error as they do a frame's.

    The camera moved where the off-line smoother finds a change point and the transforms before and after it differ by
    ``verify``'s test at :data:`CHANCE`; otherwise it is one stretch.  Raises ValueError if too little was measured.

    A stretch's transform is always the one as measured, also where ``valid_by`` is ``reference``: what is published
    then is the reference after the motion since the episode's first frames, which says nothing about where the camera
    was before them.  The bound that ``valid_by`` names is widened by how far each frame's published transform is from
    the stretch's, so that it holds for that.
    """
    episode = _Episode(table, alerts, reasons, policy)
    begins, motions = [0], [dict[str, Any]()]
    ends = [*(point.index for point in episode.change_points[1:]), len(table)]
    for point, end in zip(episode.change_points, ends, strict=False):  # without a change point there is one end more
        if (motion := episode.motion(point, begins[-1], end)) is not None:
            begins.append(point.index)
            motions.append(motion)
    rows = [
        episode.stretch(number, slice(begin, end), motion)
        for number, (begin, end, motion) in enumerate(zip(begins, [*begins[1:], len(table)], motions, strict=True))
    ]
    moved = len(rows) > 1 or rows[0].crept_m is not None
    return [msgspec.structs.replace(row, moved=moved) for row in rows]


class _Episode:
    """``poses`` (n, 4, 4): as measured; ``named`` (n, 4, 4): what ``valid_by`` names, which ``bounds`` (n, 2), m and
    rad, are about; ``measured``, ``valid`` (n,): which frames are.
    """

    def __init__(
        self,
        table: FrameTable,
        alerts: Sequence[tuple[int, Alert]],
        reasons: Sequence[str | None],
        policy: PolicySettings,
    ) -> None:
        self.table, self.alerts, self.reasons, self.policy = table, alerts, reasons, policy
        as_measured = dataclasses.replace(table, cam_T_grip=table.absolute)
        self.smoothed = correct_table(as_measured)
        self.change_points = sorted(self.smoothed.change_points, key=lambda point: point.index)
        self.poses, self.named = pose_matrices(table.absolute), table.matrices()
        self.bounds = np.column_stack([table.protection_m, table.protection_rad])
        self.measured: Bools = as_measured.measured
        self.valid: Bools = self.measured & (table.verdict == table.VERDICTS.index(Verdict.VALID.value))

    def used(self, part: slice) -> NDArray[np.intp]:
        """The frames from which a transform is averaged: the valid ones, or if there are none all measured ones."""
        rows = np.flatnonzero(self.valid[part])
        return part.start + (rows if len(rows) else np.flatnonzero(self.measured[part]))

    def motion(self, point: ChangePoint, begin: int, end: int) -> dict[str, Any] | None:
        """The columns of the motion at a change point between two frames; None where it is no more than chance."""
        before, after = self.used(slice(begin, point.index)), self.used(slice(point.index, end))
        if not len(before) or not len(after):
            return None
        found = _compared(self.poses, self.table.covariance, before, after)
        if found.p_value >= CHANCE:
            return None
        last_ns = int(self.table.stamp_ns[end - 1])
        around = [alert for stamp_ns, alert in self.alerts if point.earliest_ns <= stamp_ns <= last_ns]
        causes = [str(alert.cause) for alert in around if alert.tcp_shift_m is not None]
        return {
            "motion_ns": point.stamp_ns, "motion_earliest_ns": point.earliest_ns, "motion_latest_ns": point.latest_ns,
            "motion_m": float(np.linalg.norm(found.position_m)), "motion_xyz_m": tuple(found.position_m.tolist()),
            "motion_rad": float(np.linalg.norm(found.rotation_rad)), "motion_p_value": found.p_value,
            "motion_cause": next((cause for cause in reversed(causes) if cause != "unknown"), "unknown"),
        }  # fmt: skip

    def stretch(self, number: int, part: slice, motion: dict[str, Any]) -> Stretch:
        """The row of the frames ``part``, before which the camera made a ``motion``, empty for the first."""
        table, stamp_ns, used = self.table, self.table.stamp_ns[part], self.used(part)
        row = motion | {
            "stretch": number, "start_ns": int(stamp_ns[0]), "end_ns": int(stamp_ns[-1]), "frames": len(stamp_ns),
            "measured_share": float(self.measured[part].mean()), "valid_share": float(self.valid[part].mean()),
            "valid_by": table.VALID_BY[table.valid_by[part.start]],
        }  # fmt: skip
        # Numbers differ from frame to frame, and so does text in brackets.
        why = Counter(_NUMBER.sub("…", reason.partition(" (")[0]) for reason in self.reasons[part] if reason)
        reasons = [f"{often(count)}: {reason}" for reason, count in why.most_common(3)]
        holds = np.zeros(len(table), dtype=bool)
        if len(used):
            mean, covariance = mean_of_one_scene(list(self.poses[used]), list(table.covariance[used]))
            halves = used[: (len(used) + 1) // 2], used[len(used) // 2 :]
            crept = _compared(self.smoothed.cam_T_grip, self.smoothed.covariance, *halves)
            moved = crept.p_value < CHANCE
            bounds = self.bounds[used] + _lengths(mean, self.named[used])
            within = (bounds <= [self.policy.alert_limit_m, self.policy.alert_limit_rad]).all(axis=1)
            # Those who join a camera that crept to its one transform are told that they are several.
            holds[used] = self.valid[used] & within & (within.all() or not moved)
            if self.valid[used].all() and not holds.any():
                reasons.insert(0, self._beyond(bounds.max(axis=0), mean, used))
            record = to_record(mean)
            row |= {
                "verdict": Verdict.VALID.value if holds.any() else Verdict.SUSPECT.value,
                "cam_T_grip": (*record.translation_m, *record.rotation_xyzw),
                "covariance": tuple(covariance.ravel().tolist()),
                "crept_m": float(np.linalg.norm(crept.position_m)) if moved else None,
                **self._bounds(mean, used[holds[used]] if holds.any() else used),
            }
        return Stretch(**row, not_valid_ns=_runs(stamp_ns, ~holds[part]), reason="; ".join(reasons) or None)

    def _beyond(self, bound: Array, mean: Array, used: NDArray[np.intp]) -> str:
        """Why valid frames give no valid row."""
        text = f"as one transform {past_alert_limit(Protection(float(bound[0]), float(bound[1]), 0.0), self.policy)}"
        if self.policy.valid_by is ValidBy.ABSOLUTE:
            return text
        away_m = float(np.median(_lengths(mean, self.named[used])[:, 0]))
        return f"{text}, measured {in_mm(away_m)} mm from where the reference has it"

    def _bounds(self, mean: Array, rows: NDArray[np.intp]) -> dict[str, Any]:
        """The columns of the bounds on one transform for all of ``rows``."""
        table = self.table
        way = _lengths(mean, self.poses[rows])
        since = np.column_stack([table.since_reference_m[rows], table.since_reference_rad[rows]]) + way
        absolute = np.column_stack([table.absolute_m[rows], table.absolute_rad[rows]]) + way
        published = self.bounds[rows] + _lengths(mean, self.named[rows])
        bounds = {"protection": published, "since_reference": since, "absolute": absolute}
        known = {f"{name}_m": _largest(values[:, 0]) for name, values in bounds.items()}
        known |= {f"{name}_rad": _largest(values[:, 1]) for name, values in bounds.items()}
        since_code, since_ns = int(table.since[rows[-1]]), int(table.since_ns[rows[-1]])
        return known | {
            "integrity_risk": _largest(table.integrity_risk[rows]),
            "since": table.SINCE[since_code] if since_code >= 0 else None,
            "since_ns": since_ns if since_ns >= 0 else None,
        }


def _compared(poses: Array, covariances: Array, before: NDArray[np.intp], after: NDArray[np.intp]) -> HandEyeDifference:
    (a, A), (b, B) = (mean_of_one_scene(list(poses[rows]), list(covariances[rows])) for rows in (before, after))
    return compare_hand_eye(a, A, b, B)


def _lengths(mean: Array, poses: Array) -> Array:
    """(n, 2) how far transforms (n, 4, 4) are from one (4, 4): the TCP, m, and the turn, rad."""
    away = to_vectors(mean, poses)
    return np.column_stack([np.linalg.norm(away[:, :3], axis=1), np.linalg.norm(away[:, 3:], axis=1)])


def _runs(stamp_ns: NDArray[np.int64], chosen: Bools) -> tuple[tuple[int, int], ...]:
    """First and last stamp of each run of chosen frames."""
    changes = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return tuple(zip(stamp_ns[changes[::2]].tolist(), stamp_ns[changes[1::2] - 1].tolist(), strict=True))


def _largest(values: Array) -> float | None:
    """The largest; None if any is unknown, since there is no bound then."""
    return float(values.max()) if np.isfinite(values).all() else None
