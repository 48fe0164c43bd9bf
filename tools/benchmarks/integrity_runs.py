"""The monitor over one scene of ``tools/bench integrity``: what it published in each frame against the truth.

The result of a scene is a dictionary of plain values, one line of JSON: lists have an element a frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Literal

import msgspec
import numpy as np
from scipy import stats

from benchmarks import kit, rendered
from benchmarks.drawn import reference_record
from benchmarks.integrity_limits import AlertLimits, frozen_limits
from benchmarks.integrity_practice import CONDITIONS
from benchmarks.integrity_scenes import Fingers, IntegrityScene, make_integrity_scene
from benchmarks.machine import commit
from benchmarks.outline_seen import outline_seen
from benchmarks.rendered import Rendered
from gripmon.belief.core import Believed
from gripmon.judge.drift import DriftSettings
from gripmon.judge.policy.judging import NO_REFERENCE
from gripmon.model.geometry import from_record, perturb, perturbation_between, rotation_angle
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Array,
    Cause,
    Frame,
    FrameRecord,
    Origin,
    ValidBy,
    Verdict,
)
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import Bump

TIP_SEEN = 0.4
"""Share of a fingertip's edges from which its outline counts as seen; two of them show: one nearly whole is enough."""
_WHOLE = 0.995
BELIEF = "belief"
"""Instead of a bound's name: what the belief says beside the rules is judged, by the motion since the reference."""
_CONFIRMED_FRAMES = 3
_BENT_MM = 0.05
_LIT = (0.15, 3.0)  # exposures between which an image isn't black or white
_BY_NAME = {condition.name: condition for condition in CONDITIONS}


class View(IntEnum):
    """What is seen of the gripper in a frame."""

    FREE = 0
    BOTH_TIPS = 1
    ONE_TIP = 2
    NO_TIP = 3


@dataclass(frozen=True)
class Look:
    """A frame with its truth.  ``enough``: ``valid`` may be asked for as far as the view allows."""

    frame: Frame
    cam_T_grip: Array
    view: View
    enough: bool


@dataclass(frozen=True)
class Watched:
    """A sequence, with what the monitor knows before it, and what it is judged by."""

    sequence: IntegrityScene | Rendered
    true_start_cam_T_grip: Array
    wrong: tuple[Cause, ...]
    inside: bool
    looks: Iterable[Look]
    limits: AlertLimits
    response: Literal["linear", "srgb"] = "linear"
    knock: tuple[int, float] | None = None
    """The first frame after the mount's jump, and its size at the TCP (m)."""


def names() -> list[str]:
    """Names of all conditions, and of the rendered sequences that are there."""
    return [*_BY_NAME, *rendered.all_row_names()]


def is_rendered(name: str) -> bool:
    return name not in _BY_NAME


def about(name: str) -> str:
    """What happens in a condition."""
    return "independent renderer" if is_rendered(name) else _BY_NAME[name].what


def scene_numbers(name: str, scenes: int) -> range:
    """Scenes of a condition; of a rendered sequence there are as many as there are."""
    return range(len(rendered.sequences(name)) if is_rendered(name) else scenes)


def run_scene(name: str, seed: int, number: int, frames: int, valid_by: str = "") -> dict[str, Any]:
    """One scene, judged; ``valid_by``: as the product's setting, empty for its default."""
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    if is_rendered(name):
        watched = _rendered(rendered.sequences(name)[number])
    else:
        watched = _simulated(make_integrity_scene(_BY_NAME[name], seed, number, frames))
    settings = _settings(watched)
    if valid_by not in ("", BELIEF):
        policy = msgspec.structs.replace(settings.policy, valid_by=msgspec.convert(valid_by, ValidBy))
        settings = msgspec.structs.replace(settings, policy=policy)
    known = watched.sequence
    start = reference_record(known.start_cam_T_grip, known.start_covariance, 0)
    monitor = Monitor(known.camera, known.gripper, settings, start, None, shadow=valid_by == BELIEF)
    truth = Truth(known.start_cam_T_grip, watched.true_start_cam_T_grip)
    rows: list[dict[str, Any]] = []
    alerts: list[list[Any]] = []
    moved: list[int] = []
    grey_dn = None
    for index, look in enumerate(watched.looks):
        record = monitor.process(look.frame)
        row = _judged(record, look, truth, settings.policy.integrity_risk)
        if monitor.shadow is not None:
            row |= _believed(monitor.shadow.newest, look, truth, watched.limits)
        rows.append(row)
        alerts += [[index, alert.text] for alert in record.alerts if is_false(alert, watched.wrong)]
        moved += [index for alert in record.alerts if names_a_move(alert)]
        grey_dn = _grey_dn(look.frame) if grey_dn is None else grey_dn
    return {
        "condition": name,
        "seed": seed,
        "scene": number,
        "asked": frames,
        "commit": commit(),
        "grey_dn": grey_dn,
        **_setting(watched, settings),
        "valid_by": valid_by if valid_by == BELIEF else str(record.valid_by),
        "false_alerts": alerts,
        "moved_alerts": moved,
        "seconds": round(time.perf_counter() - start_s, 2),
        "cpu_s": round(time.process_time() - start_cpu_s, 2),
        **{key: [row[key] for row in rows] for key in rows[0]},
    }


def _setting(watched: Watched, settings: MonitorSettings) -> dict[str, Any]:
    """What a scene is, apart from its frames."""
    known = watched.sequence
    return {
        "gripper": known.gripper.name,
        "fps": known.fps,
        "depth_m": _short(known.start_cam_T_grip[2, 3]),
        "focal_px": _short(known.camera.fx_px),
        "jaw_exact": known.jaw_sigma_m == 0.0,
        "inside": watched.inside,
        "limit_m": settings.policy.alert_limit_m,
        "limit_rad": settings.policy.alert_limit_rad,
        "knock": None if watched.knock is None else list(watched.knock),
    }


def _grey_dn(frame: Frame) -> float:
    """Mean grey of an image: whether two runs saw the same scene."""
    assert isinstance(frame.image, np.ndarray)
    return round(float(frame.image.mean()), 2)


def names_a_move(alert: Alert) -> bool:
    """Whether an alert newly says that the camera moved."""
    return alert.event is AlertEvent.RAISED and alert.kind in (AlertKind.STEP, AlertKind.CREEP, AlertKind.DRIFT)


def is_false(alert: Alert, wrong: tuple[Cause, ...]) -> bool:
    """Whether an alert newly names what isn't ``wrong``: that the camera's mount moved, or what gripper or lens did."""
    named = alert.cause in (*NO_REFERENCE, Cause.CAMERA_MOUNT) and alert.kind is not AlertKind.VIBRATION
    new = alert.event in (AlertEvent.RAISED, AlertEvent.UPDATED)
    return named and new and alert.cause not in wrong


def normal_level_m(covariance: Array, risk: float) -> float:
    """The least that a protection level can be with a covariance (6, 6) and normal errors: that of its worst axis."""
    largest = float(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    return float(stats.norm.isf(0.5 * risk)) * largest**0.5


@dataclass
class Truth:
    """What a transform has to be: the true pose, or the reference moved as the gripper has truly moved since the frames
    that the record counts from.

    ``true_start_cam_T_grip``: the true pose of which the reference is a measurement.
    """

    reference_cam_T_grip: Array
    true_start_cam_T_grip: Array
    seen: dict[int, Array] = field(default_factory=dict)
    """True poses by the stamps of the frames."""

    def of(self, record: FrameRecord, true_cam_T_grip: Array) -> Array:
        """What a record's ``cam_T_grip`` has to be, at the true pose."""
        self.seen[record.stamp_ns] = true_cam_T_grip
        since = record.since_reference
        if since is None or record.valid_by != "reference":
            return true_cam_T_grip
        proved = since.since == "first_proved"
        then = self.seen[since.since_ns] if proved else self.true_start_cam_T_grip
        return perturb(self.reference_cam_T_grip, perturbation_between(then, true_cam_T_grip))


def bounds_of(record: FrameRecord) -> dict[str, tuple[float, float] | None]:
    """Both bounds on position (m) and rotation (rad)."""
    named = {"reference": record.since_reference, "absolute": record.absolute}
    return {name: None if b is None else (b.position_m, b.rotation_rad) for name, b in named.items()}


def _judged(record: FrameRecord, look: Look, truth: Truth, risk: float) -> dict[str, Any]:
    """A record against the truth: errors and bounds in m and rad, None where nothing was published."""
    out: dict[str, Any] = {
        "view": int(look.view),
        "enough": look.enough,
        "valid": record.verdict is Verdict.VALID,
        "error_m": None,
        "error_rad": None,
        "level_m": None,
        "level_rad": None,
        "floor_m": None,
        "nees": None,
        "absolute_error_m": None,
        "why": "",
        "reason": record.reason or "",
    }
    true_T = truth.of(record, look.cam_T_grip)
    for name, bound in bounds_of(record).items():
        out[f"{name}_m"], out[f"{name}_rad"] = (None, None) if bound is None else (_short(b) for b in bound)
    if record.cam_T_grip is None or record.covariance is None:
        return out
    cam_T_grip = from_record(record.cam_T_grip)
    measured_T = from_record(record.measured_T or record.cam_T_grip)
    out["absolute_error_m"] = _short(np.linalg.norm(measured_T[:3, 3] - look.cam_T_grip[:3, 3]))
    error = perturbation_between(cam_T_grip, true_T)
    out["error_m"] = _short(np.linalg.norm(error[:3]))
    out["error_rad"] = _short(rotation_angle(cam_T_grip[:3, :3].T @ true_T[:3, :3]))
    if record.source is not Origin.HELD:
        covariance = np.reshape(record.covariance, (6, 6))
        out["nees"] = _short(kit.nees(error, covariance))
        out["floor_m"] = _short(normal_level_m(covariance, risk))
    if record.protection is not None:
        out["level_m"] = _short(record.protection.position_m)
        out["level_rad"] = _short(record.protection.rotation_rad)
        out["why"] = record.protection.hypothesis
    return out


def _believed(believed: Believed | None, look: Look, truth: Truth, limits: AlertLimits) -> dict[str, Any]:
    """The columns of :func:`_judged` by the belief: its motion since the reference against the true one."""
    out: dict[str, Any] = dict.fromkeys(
        ("error_m", "error_rad", "level_m", "level_rad", "floor_m", "nees", "absolute_error_m", "reference_m",
         "reference_rad", "absolute_m", "absolute_rad")
    )  # fmt: skip
    out |= {"valid": False, "why": "", "reason": ""}
    if believed is None or not believed.known:
        return out
    true_motion = perturbation_between(truth.true_start_cam_T_grip, look.cam_T_grip)
    true_place = perturbation_between(truth.reference_cam_T_grip, look.cam_T_grip)
    error, bound = believed.motion - true_motion, believed.bound
    place = believed.motion + believed.reference_error - true_place
    out["error_m"], out["error_rad"] = _short(np.linalg.norm(error[:3])), _short(np.linalg.norm(error[3:]))
    out["absolute_error_m"] = _short(np.linalg.norm(place[:3]))
    if math.isfinite(bound.position_m):
        out["level_m"] = out["reference_m"] = _short(bound.position_m)
        out["level_rad"] = out["reference_rad"] = _short(bound.rotation_rad)
        out["absolute_m"], out["absolute_rad"] = _short(bound.absolute_m), _short(bound.absolute_rad)
        out["valid"] = bound.within(limits.position_m, limits.rotation_rad)
    return out


def _short(value: float) -> float:
    """Four digits: what pictures and counts need."""
    return float(f"{value:.4g}")


def _settings(watched: Watched) -> MonitorSettings:
    """As an integrator sets them up: the alert limits were fixed beforehand."""
    known = watched.sequence
    settings = MonitorSettings(drift=DriftSettings(frames_per_s=known.fps))
    if known.jaw_sigma_m is not None:
        settings = msgspec.structs.replace(settings, jaw_sigma_m=known.jaw_sigma_m)
    edges = msgspec.structs.replace(settings.corners.edges, response=watched.response)
    settings = msgspec.structs.replace(settings, corners=msgspec.structs.replace(settings.corners, edges=edges))
    limits = watched.limits
    policy = msgspec.structs.replace(
        settings.policy, alert_limit_m=limits.position_m, alert_limit_rad=limits.rotation_rad
    )
    return msgspec.structs.replace(settings, policy=policy)


def _simulated(scene: IntegrityScene) -> Watched:
    simulator, condition = scene.simulator, scene.condition

    def looks() -> Iterator[Look]:
        for index in scene.indices:
            truth = simulator.truth(index)
            lit = _LIT[0] <= truth.exposure <= _LIT[1]
            enough = condition.enough and not _just_bumped(simulator.scenario, truth.time_s)
            view = _view(scene, index) if lit else View.NO_TIP
            yield Look(simulator.frame(index), truth.cam_T_grip, view, enough)

    return Watched(
        scene,
        simulator.truth(scene.first).cam_T_grip,
        condition.wrong,
        scene.first > 0,
        looks(),
        _frozen(scene, _limits_of(scene)),
        response=simulator.scenario.sensor.response,
        knock=_knock(scene),
    )


def _limits_of(scene: IntegrityScene) -> str:
    """Whose alert limits: of a gripper, or of what the border leaves of any."""
    return Fingers.SHORT.value if scene.condition.fingers is Fingers.SHORT else scene.gripper.name


def _frozen(known: IntegrityScene | Rendered, whose: str) -> AlertLimits:
    px_per_mm = 1e-3 * known.camera.fx_px / float(known.start_cam_T_grip[2, 3])
    return frozen_limits(whose, known.jaw_sigma_m == 0.0, px_per_mm)


def _knock(scene: IntegrityScene) -> tuple[int, float] | None:
    """The first frame after the mount's jump, counted from the sequence's first, and its size at the TCP (m)."""
    bumps = [bump for bump in scene.simulator.scenario.mount if isinstance(bump, Bump)]
    if not bumps:
        return None
    last = scene.first + scene.frames - 1
    before, after = (scene.simulator.truth(index).cam_T_grip[:3, 3] for index in (scene.first, last))
    at = math.ceil(bumps[0].at_s * scene.simulator.scenario.fps) - scene.first
    return at, _short(np.linalg.norm(after - before))


def _just_bumped(scenario: Scenario, time_s: float) -> bool:
    """Whether the mount has jumped a moment ago: what jumped has to be confirmed, or still rings."""
    settled_s = _CONFIRMED_FRAMES / scenario.fps
    return any(
        0.0 <= time_s - bump.at_s < (5.0 * bump.ring_decay_s if bump.ring_fraction > 0.0 else 0.0) + settled_s
        for bump in scenario.mount
        if isinstance(bump, Bump)
    )


def _view(scene: IntegrityScene, index: int) -> View:
    seen = outline_seen(scene.simulator, index)
    if (seen.tips > _WHOLE).all() and (seen.edges > _WHOLE).all():
        return View.FREE
    # A pad is a body of its own, named after its finger.
    tips: dict[str, list[float]] = {}
    for name, share in zip(scene.simulator.gripper.finger_ids, seen.tips.tolist(), strict=True):
        tips.setdefault(name.removesuffix(" pad"), []).append(share)
    return _by_tips(sum(sum(shares) >= TIP_SEEN * len(shares) for shares in tips.values()))


def _by_tips(tips: int) -> View:
    return View.BOTH_TIPS if tips >= 2 else View.ONE_TIP if tips == 1 else View.NO_TIP


def _rendered(sequence: Rendered) -> Watched:
    """The truth there names the corners that something hides; a tip with none left counts as hidden."""
    first = np.array(sequence.frames[0]["camera_T_gripper"])
    moves = any(not np.allclose(frame["camera_T_gripper"], first, atol=1e-9) for frame in sequence.frames)
    # The jaws move both fingers alike, to either side.
    ways_mm = np.array([list(frame["finger_offset_mm"].values()) for frame in sequence.frames])
    bent = bool(np.abs(ways_mm[:, 0] * (-1.0, 1.0, 1.0) - ways_mm[:, 1]).max() > _BENT_MM)

    def looks() -> Iterator[Look]:
        for shot in sequence.shots():
            truth = sequence.frames[shot.frame.seq // sequence.repeat]
            hidden = {*truth["occluded"], *truth["outside"]}
            tips = {name[0] for name in truth["corners"] if name not in hidden}
            free = not hidden and not truth["conditions"]["held"] and not truth["conditions"]["hand"]
            yield Look(shot.frame, shot.cam_T_grip, View.FREE if free else _by_tips(len(tips)), not bent)

    return Watched(
        sequence,
        first,
        (Cause.CAMERA_MOUNT,) * moves + (Cause.FINGER_BENT,) * bent,
        False,
        looks(),
        _frozen(sequence, f"rendered {sequence.gripper.name}"),
    )
