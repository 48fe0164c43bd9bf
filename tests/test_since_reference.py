"""The bound since the reference, against simulated truth: what cancels, what doesn't, and when it begins."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.meters import box_gripper, difference, moved
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import pose_of, reference_of, rendered

from gripmon.judge.policy import PolicySettings
from gripmon.model.camera import make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import (
    CommandReply,
    Frame,
    FrameRecord,
    MonitorState,
    Protection,
    Since,
    ValidBy,
    Verdict,
    from_json,
    to_json,
)
from gripmon.monitor import Monitor, MonitorSettings, trust
from gripmon.monitor.common import CommonError
from gripmon.monitor.since import FIRST_FRAMES, UNSETTLED_FRAMES, AtReference, AtReferences, Opened
from gripmon.monitor.tracker import Tracker
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import (
    Bump,
    Creep,
    FingerLook,
    FingerShape,
    JawScript,
    Light,
    LightStep,
    MountScript,
    Sensor,
    Vibration,
)
from gripmon.track.edges import FingerEndsSeen, Measurement
from gripmon.track.integrity import Separation
from gripmon.track.integrity.level_kernel import doubted
from gripmon.track.integrity.level_kernel import moved as moved_since

BY_REFERENCE = PolicySettings(valid_by=ValidBy.REFERENCE)
FPS, KNOCK_M = 20.0, (0.002, 0.0, 0.002)
KNOCKED = 19
"""Frame from which on the mount is knocked."""

KNOCK = Bump(at_s=(KNOCKED - 0.6) / FPS, ring_fraction=0.0, translation_m=KNOCK_M)
CLOSING = JawScript(knots=((0.5, 0.034), (1.0, 0.014)))
KEPT = Path(__file__).parent / "kept" / "schema_1"


class Seen(NamedTuple):
    """A sequence's records, and (n,) errors and bounds: of the published motion since the reference, and absolute."""

    records: list[FrameRecord]
    error_m: np.ndarray
    bound_m: np.ndarray
    error_rad: np.ndarray
    bound_rad: np.ndarray
    absolute_error_m: np.ndarray
    absolute_m: np.ndarray
    monitor: Monitor

    @property
    def valid(self) -> float:
        return float(np.mean([r.verdict is Verdict.VALID for r in self.records[1:]]))


def scene(frames: int = 28, **sections: object) -> Scenario:
    return Scenario(name="since", fps=FPS, duration_s=frames / FPS, **sections)


def scaled(gripper: Gripper, factor: float, sigma: float) -> Gripper:
    """A file that has another scale, at the nominal opening; the report of the opening stays in metres."""
    model = gripper.model
    points = {
        name: msgspec.structs.replace(point, xyz_m=tuple(factor * v for v in point.xyz_m))
        for name, point in model.points.items()
    }
    return Gripper(msgspec.structs.replace(model, points=points, scale_sigma=sigma))


def reference_at(pose: np.ndarray, sigma_m: float = 1e-3, sigma_rad: float = 1e-2):
    covariance = np.diag(np.square([sigma_m] * 3 + [sigma_rad] * 3))
    return msgspec.structs.replace(reference_of(pose), covariance=tuple(covariance.ravel().tolist()))


@lru_cache(maxsize=8)
def seen(
    scenario: Scenario,
    off: tuple[float, ...] = (0.0,) * 6,
    scale: float = 1.0,
    policy: PolicySettings = BY_REFERENCE,
) -> Seen:
    """``off`` (6,): by how much the reference is wrong; ``scale``: of the gripper file, known to 1 % if it isn't 1."""
    true, pose, camera = box_gripper(sharp=False), nominal_cam_T_grip(), make_camera(PAPER_LENS)
    file = true if scale == 1.0 else scaled(true, scale, 0.01)
    reference_T = moved(pose, np.array(off))
    monitor = Monitor(camera, file, MonitorSettings(policy=policy), reference_at(reference_T))
    frames, truths = rendered(scenario)
    first_T, records, rows = truths[0].cam_T_grip, [], []
    for frame, truth in zip(frames, truths, strict=True):
        record = monitor.process(frame)
        monitor.run_pending()
        assert record.cam_T_grip is not None and record.measured_T is not None and record.absolute is not None
        truth_T, since = truth.cam_T_grip, record.since_reference
        error = difference(pose_of(record.cam_T_grip), truth_T @ np.linalg.inv(first_T) @ reference_T)
        absolute = difference(pose_of(record.measured_T), truth_T)
        assert since is not None
        records.append(record)
        rows.append(
            (
                np.linalg.norm(error[:3]),
                since.position_m,
                np.linalg.norm(error[3:]),
                since.rotation_rad,
                np.linalg.norm(absolute[:3]),
                record.absolute.position_m,
            )
        )
    return Seen(records, *np.array(rows).T, monitor)


def assert_within(run: Seen) -> None:
    assert (run.error_m <= run.bound_m).all() and (run.error_rad <= run.bound_rad).all()


# --- the equations ---


def at_reference(cam_T_grip: np.ndarray, count: int = 1, sigma: float = 1e-4) -> AtReference:
    fits = Separation(
        np.zeros((count, 6)), np.tile(np.diag(np.square([sigma] * 6)), (count, 1, 1)), np.zeros((count, 1, 6))
    )
    return AtReference(cam_T_grip, fits, 0.03, 30, Since.FIRST_PROVED, 0, 1e-6, True)


def random_pose(rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
    pose[:3, 3] = 0.1 * size * rng.normal(size=3)
    return pose


def test_a_pose_is_the_motion_times_the_references_error_times_the_reference():
    rng = np.random.default_rng(1)
    reference_T, b_T, d_T = random_pose(rng), random_pose(rng, 0.01), random_pose(rng, 0.03)
    at = at_reference(b_T @ reference_T)
    np.testing.assert_allclose(at.motion(d_T @ b_T @ reference_T), d_T, atol=1e-14)
    # An error that is constant in gripper axes is in both poses.
    wrong_T = random_pose(rng, 0.02)
    off = at_reference(b_T @ reference_T @ wrong_T)
    np.testing.assert_allclose(off.motion(d_T @ b_T @ reference_T @ wrong_T), d_T, atol=1e-14)


def test_its_covariance_and_its_differences_are_those_of_the_published_pose():
    """By central differences of exp(d) reference, in the errors of both poses."""
    rng = np.random.default_rng(2)
    reference_T = random_pose(rng)
    x_T = random_pose(rng, 0.05) @ reference_T
    b_T = moved(reference_T, np.array([2e-3, -1e-3, 3e-3, 0.01, 0.0, -0.02]))

    def published(of_x: np.ndarray, of_b: np.ndarray) -> np.ndarray:
        return at_reference(perturb(b_T, of_b)).motion(perturb(x_T, of_x)) @ reference_T

    step, none = 1e-6, np.zeros(6)
    base = published(none, none)
    jacobian = np.zeros((2, 6, 6))
    for k, e in enumerate(step * np.eye(6)):
        for which, (plus, minus) in enumerate((((e, none), (-e, none)), ((none, e), (none, -e)))):
            way = perturbation_between(base, published(*plus)) - perturbation_between(base, published(*minus))
            jacobian[which, :, k] = way / (2.0 * step)
    at, root = at_reference(b_T, 3), rng.normal(size=(6, 6)) * 1e-4
    expected = jacobian[0] @ root @ root.T @ jacobian[0].T + jacobian[1] @ at.fits.covariance[0] @ jacobian[1].T
    np.testing.assert_allclose(at.covariance_of(root @ root.T, x_T, reference_T), expected, rtol=1e-5, atol=1e-16)
    # The same of fits under hypotheses: a shift of x, and one of b.
    of_x, of_b = 1e-4 * rng.normal(size=(2, 6)), 1e-4 * rng.normal(size=(3, 6))
    at = at._replace(fits=at.fits._replace(shift=of_b))
    which, prior, exact, unknown = np.array([0, 2]), np.ones(2), np.zeros((2, 1, 6)), np.zeros((0, 6))
    begun, *first = at.differences(x_T, reference_T, Opened(0.03, none), None, none)
    table, same = np.empty((2, 7, 2))
    fits = of_x, np.tile(root @ root.T, (2, 1, 1)), exact, prior
    moved_since(*fits, which, *begun, *first, unknown, unknown, np.zeros((6, 6)), 0.0, 1.0, 0.0, table, 0)
    ways = of_x @ jacobian[0].T + of_b[which] @ jacobian[1].T
    doubted(ways, np.tile(expected, (2, 1, 1)), exact, prior, unknown, np.zeros(2), 1.0, 0.0, same)
    np.testing.assert_allclose(table, same, rtol=1e-4)


def test_a_wrong_scale_counts_by_the_motion_and_the_jaws_travel():
    rng = np.random.default_rng(3)
    reference_T, s = random_pose(rng), 0.01
    x_T = random_pose(rng, 0.03) @ reference_T
    larger = [np.array(each) for each in (x_T, reference_T)]
    for each in larger:
        each[:3, 3] *= 1.0 + s
    exact, off = at_reference(reference_T).motion(x_T), at_reference(larger[1]).motion(larger[0])
    way = perturbation_between(exact @ reference_T, off @ reference_T)
    common = CommonError(s, np.zeros((0, 6)), np.zeros(6))
    at, rate = at_reference(reference_T), rng.normal(size=6)

    def of_scale(opening_m: float) -> np.ndarray:
        _, _, by_motion, travel, origin, *_ = at.differences(
            x_T, reference_T, Opened(opening_m, rate), common, np.zeros(6)
        )
        return by_motion[0] @ origin + travel

    np.testing.assert_allclose(-of_scale(0.03), way, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(of_scale(0.05) - of_scale(0.03), s * 0.02 * rate, rtol=1e-9, atol=1e-12)


def test_edges_taught_at_a_wrong_reference_count_by_the_motion():
    at_T, motion = np.eye(4), np.eye(4)
    at_T[2, 3], motion[:3, 3] = 0.1, (3e-3, 0.0, 4e-3)
    taught = np.array([[0.0, 0.0, 1e-3, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.02, 0.0, 0.0]])
    covariance = CommonError(0.0, taught, np.zeros(6)).of_motion(motion, at_T)
    # One part in a hundred of the distance, and 0.02 rad, of 5 mm.
    np.testing.assert_allclose(np.sqrt(covariance.diagonal()), [5e-3 * np.hypot(0.01, 0.02)] * 3 + [0.0] * 3)
    assert not CommonError(0.0, taught, np.zeros(6)).of_motion(np.eye(4), at_T).any()


# --- simulated truth ---


def test_a_wrong_reference_is_no_motion():
    """It is off by 0.5 mm and 3 mrad: what is published is as far from the reference as the mount has moved, not as far
    as the gripper stands from it.
    """
    run = seen(scene(mount=(KNOCK,)), off=(3e-4, 2e-4, 3.5e-4, 3e-3, 0.0, 0.0))
    assert_within(run)
    # The first frames are searched from the wrong place, and found wrong; the knock's own frame isn't sure yet.
    assert run.error_m[8:].max() < 5e-5
    for settled in (slice(8, KNOCKED), slice(KNOCKED + 3, None)):
        assert run.bound_m[settled].max() < 4e-4
        assert all(r.verdict is Verdict.VALID for r in run.records[settled])


@pytest.mark.parametrize("jaw", [JawScript(), CLOSING], ids=["", "closing"])
def test_a_wrong_scale_is_in_the_absolute_bound_alone(jaw: JawScript):
    mount = (KNOCK,) if jaw is not CLOSING else ()
    run = seen(scene(jaw=jaw, mount=mount), scale=1.0 / 1.01)
    assert_within(run)
    assert np.median(run.absolute_error_m) > 1e-3 and np.median(run.absolute_m) > 4e-3
    assert np.median(run.error_m) < 1e-4
    still = run.bound_m[2:10]
    assert still.max() < 0.1 * run.absolute_m[2:10].min()
    if jaw is CLOSING:  # the reported travel contradicts a file of another size
        assert run.bound_m[-1] > 2.0 * still.max()
    else:
        assert run.valid > 0.85


@pytest.mark.parametrize("jaw", [JawScript(), CLOSING], ids=["", "closing"])
def test_tips_with_bevels_that_no_file_states_are_no_motion(jaw: JawScript):
    fingers = FingerLook(shape=FingerShape(tip_bevel_m=3e-4))
    run = seen(scene(fingers=fingers, jaw=jaw, mount=() if jaw is CLOSING else (KNOCK,)))
    assert_within(run)
    assert np.median(run.absolute_error_m) > 1.5e-4 and np.median(run.error_m) < 5e-5


def test_a_knock_is_seen_in_the_motion():
    run = seen(scene(mount=(KNOCK,)), scale=1.0 / 1.01)
    for record in run.records[KNOCKED + 3 :]:
        assert record.drift is not None and record.valid_by is ValidBy.REFERENCE
        np.testing.assert_allclose(record.drift.tcp_shift_m, KNOCK_M, atol=1e-4)
        assert record.drift.translation_m == pytest.approx(np.linalg.norm(KNOCK_M), abs=1e-4)


@pytest.mark.parametrize("share", [0.5, 0.75, 0.9])
@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_a_knock_during_an_exposure_shows_the_gripper_twice_and_is_not_valid_at_the_old_place(
    share: float, times: float
):
    """``share`` of the light is from after it: the truth at the middle of the exposure is there, too."""
    at_s = KNOCKED / FPS + (0.5 - share) * Sensor().exposure_time_s
    knock = Bump(at_s=at_s - 1e-6, ring_fraction=0.0, translation_m=tuple(times * m for m in KNOCK_M))
    run = seen(scene(mount=(knock,)))
    assert run.records[KNOCKED - 1].verdict is Verdict.VALID
    for record, error_m, bound_m in zip(run.records, run.error_m, run.bound_m, strict=True):
        assert record.verdict is not Verdict.VALID or error_m < bound_m
    assert run.records[-1].verdict is Verdict.VALID and run.error_m[-1] < 1e-4


def test_a_lamp_that_goes_off_shows_nothing_twice():
    lamp = Light(steps=(LightStep(at_s=(KNOCKED - 0.5) / FPS, factor=0.4),))
    assert all(record.verdict is Verdict.VALID for record in seen(scene(light=lamp)).records[2:])


def test_what_valid_by_names_is_what_is_published_and_judged():
    by = {name: seen(scene(), scale=1.0 / 1.01, policy=PolicySettings(valid_by=name)) for name in ValidBy}
    assert by[ValidBy.REFERENCE].valid > 0.85 and by[ValidBy.ABSOLUTE].valid == 0.0
    for name, run in by.items():
        record = run.records[-1]
        assert record.since_reference is not None and record.absolute is not None and record.protection is not None
        named = record.since_reference if name is ValidBy.REFERENCE else record.absolute
        assert record.protection.position_m == named.position_m
        assert record.protection.rotation_rad == named.rotation_rad
        assert record.valid_by is name
        if name is ValidBy.ABSOLUTE:
            assert record.cam_T_grip == record.measured_T
    # The same is measured, whatever is published of it.
    measured = [pose_of(run.records[-1].measured_T) for run in by.values()]
    assert np.linalg.norm(difference(*measured)[:3]) < 5e-5


@pytest.mark.parametrize(
    "motion",
    [
        Creep(law="linear", time_s=4.0, translation_m=(2e-4, 0.0, 0.0)),
        Creep(law="linear", time_s=4.0, translation_m=(5e-4, 0.0, 0.0)),
        Vibration(translation_m=(2e-4, 0.0, 0.0), frequency_hz=1.7),
        # By 3.8 px from the second frame to the third, where three of four long edges still look like another opening.
        Vibration(translation_m=(2e-4, 0.0, 0.0), frequency_hz=6.5),
    ],
    ids=["creeps", "creeps faster", "vibrates", "vibrates faster"],
)
def test_a_mount_that_moves_in_the_first_proved_frames_is_within_its_bound(motion: MountScript):
    """By the truth at the stamp from which the motion counts, though the average follows the mount meanwhile."""
    pose, truths = nominal_cam_T_grip(), dict[int, np.ndarray]()
    settings = MonitorSettings(policy=BY_REFERENCE)
    monitor = Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), settings, reference_at(pose))
    for frame, truth in zip(*rendered(scene(80, mount=(motion,))), strict=True):
        record = monitor.process(frame)
        monitor.run_pending()
        truths[frame.stamp_ns], since = truth.cam_T_grip, record.since_reference
        assert record.cam_T_grip is not None and since is not None
        then_T = truths[since.since_ns]
        error = difference(pose_of(record.cam_T_grip), truth.cam_T_grip @ np.linalg.inv(then_T) @ pose)
        assert np.linalg.norm(error[:3]) < since.position_m and np.linalg.norm(error[3:]) < since.rotation_rad


# --- when it begins ---


class Mean:
    """Stands in for the anchor: an average of ``frames``, with a bound of a millimetre."""

    def __init__(self, cam_T_grip: np.ndarray, frames: int = 1):
        self.cam_T_grip, self.frames, self.misread, self.proven = cam_T_grip, frames, 1e-6, True

    def fits(self) -> Separation:
        return at_reference(self.cam_T_grip).fits

    def bound(self, risk: float) -> Protection:
        return Protection(1e-3, 0.02, risk)


def begun() -> AtReferences:
    return AtReferences(reference_at(np.eye(4)), ValidBy.REFERENCE, 1e-5, ())


def test_it_is_the_average_of_the_first_frames_that_proved_a_pose():
    kept, anchor = begun(), Mean(np.eye(4))
    for number in range(2 * FIRST_FRAMES):
        anchor.cam_T_grip = moved(np.eye(4), np.array([1e-6 * (number + 1), 0.0, 0.0, 0.0, 0.0, 0.0]))
        kept.add(anchor, 0.03 + 1e-5 * number, 1000 + number)
        assert kept.changes == int(number >= FIRST_FRAMES - 1)
    at = kept.current
    assert at is not None and (at.frames, at.since_ns, at.since) == (30, 1014, Since.FIRST_PROVED)
    assert at.cam_T_grip[0, 3] == pytest.approx(30e-6)
    assert at.jaw_opening_m == pytest.approx(0.03 + 1e-5 * 14.5)


def test_what_is_published_counts_from_what_its_bound_was_computed_with():
    """Not from an average that the same frame has moved on."""
    kept, anchor, way_m = begun(), Mean(np.eye(4)), 1e-3
    kept.add(anchor, 0.03, 1)
    kept.weighed = kept.current
    anchor.cam_T_grip = moved(np.eye(4), np.array([way_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    kept.add(anchor, 0.03, 2)
    assert kept.quantity(np.eye(4), np.eye(6))[0][0, 3] == 0.0
    kept.weighed = kept.current
    assert kept.quantity(np.eye(4), np.eye(6))[0][0, 3] == pytest.approx(-way_m)


def test_before_a_frame_has_proved_a_pose_the_motion_is_that_since_the_first_one():
    """Also where that isn't at the reference: a mount that moves isn't said to stand still."""
    kept, first_T = begun(), moved(np.eye(4), np.array([0.0, 0.0, 9e-3, 0.0, 0.0, 0.0]))
    way = np.array([2.5e-3, 0.0, 1e-3, 0.01, 0.0, 0.0])
    at, covariance = kept.quantity(first_T, np.eye(6))
    assert np.allclose(at, np.eye(4)) and np.allclose(covariance, 2.0 * np.eye(6))
    later, _ = kept.quantity(perturb(first_T, way), np.eye(6))
    assert later == pytest.approx(perturb(first_T, way) @ np.linalg.inv(first_T))
    kept.refer(reference_at(np.eye(4)))
    assert np.allclose(kept.quantity(perturb(first_T, way), np.eye(6))[0], np.eye(4))


@pytest.mark.parametrize(
    ("frames", "shift_m", "anew"),
    [(5, 0.9e-3, True), (5, 1.1e-3, False), (6, 0.9e-3, False), (1, 0.9e-3, True)],
)
def test_a_place_that_the_very_first_frames_allow_begins_it_anew(frames: int, shift_m: float, anew: bool):
    assert UNSETTLED_FRAMES == 5
    kept, first = begun(), Mean(np.eye(4), frames)
    kept.add(first, 0.03, 1)
    there = Mean(moved(np.eye(4), np.array([shift_m, 0.0, 0.0, 0.0, 0.0, 0.0])))
    kept.add(there, 0.03, 2)
    at = kept.current
    assert at is not None and at.since_ns == (2 if anew else 1)
    assert at.cam_T_grip[0, 3] == (shift_m if anew else 0.0)
    assert kept.changes == int(not anew)


def restarted(state: MonitorState, settings: MonitorSettings) -> Monitor:
    back = msgspec.json.decode(msgspec.json.encode(state), type=MonitorState)
    camera, gripper = make_camera(PAPER_LENS), box_gripper(sharp=False)
    return Monitor(camera, gripper, settings, reference_at(nominal_cam_T_grip()), state=back)


def test_a_restart_goes_on_with_it_and_sees_a_knock_in_between():
    pose, camera, gripper = nominal_cam_T_grip(), make_camera(PAPER_LENS), box_gripper(sharp=False)
    settings = MonitorSettings(policy=BY_REFERENCE)
    monitor = Monitor(camera, gripper, settings, reference_at(pose))
    simulator = paper_rig(gripper, pose).simulator(scene(24, mount=(KNOCK,)), 2)
    before = [monitor.process(simulator.frame(i)) for i in range(KNOCKED - 1)]
    assert monitor.state().at_reference is msgspec.UNSET  # fewer than thirty proved it
    at = monitor._trust.since
    at._end()  # as after thirty
    state = monitor.state()
    assert isinstance(state.at_reference, tuple) and len(state.at_reference) == 1

    again = restarted(state, settings)
    (kept,) = again.state().at_reference
    at_T = state.at_reference[0].cam_T_grip
    np.testing.assert_allclose(pose_of(kept.cam_T_grip), pose_of(at_T), atol=1e-12)
    assert again.since_refused is None and (msgspec.structs.replace(kept, cam_T_grip=at_T),) == state.at_reference
    after = [again.process(simulator.frame(i)) for i in range(KNOCKED, 24)]
    since = before[-1].since_reference, after[-1].since_reference
    assert since[0] is not None and since[1] is not None and since[0].since_ns == since[1].since_ns
    assert after[-1].drift is not None
    np.testing.assert_allclose(after[-1].drift.tcp_shift_m, KNOCK_M, atol=1e-4)

    others = msgspec.structs.replace(settings, jaw_sigma_m=1e-4)
    refused = restarted(state, others)
    assert "measured with other settings" in (refused.since_refused or "") and refused._trust.since.current is None
    old = restarted(msgspec.structs.replace(state, at_reference=msgspec.UNSET), settings)
    assert "from an earlier version" in (old.since_refused or "")


def test_a_knock_while_it_was_off_is_seen_in_the_motion_though_the_first_frames_after_it_prove_nothing(
    monkeypatch: pytest.MonkeyPatch,
):
    """Something hides the fingers' ends in two frames; what was known of the reference must survive these."""
    monkeypatch.setattr(trust, "PROOF_EVERY_FRAMES", 1)
    pose, camera, gripper = nominal_cam_T_grip(), make_camera(PAPER_LENS), box_gripper(sharp=False)
    settings = MonitorSettings(policy=BY_REFERENCE)
    monitor = Monitor(camera, gripper, settings, reference_at(pose))
    before = paper_rig(gripper, pose).simulator(scene(FIRST_FRAMES + 10), 2)
    for index in range(FIRST_FRAMES + 8):
        told = monitor.process(before.frame(index)).since_reference
        monitor.run_pending()
    again, knocked = restarted(monitor.state(), settings), pose.copy()
    knocked[:3, 3] += KNOCK_M
    ends, after, records = Tracker.ends, paper_rig(gripper, knocked).simulator(scene(20), 3), []

    def no_ends(tracker: Tracker, frame: Frame, measurement: Measurement) -> FingerEndsSeen:
        none = np.zeros(2, dtype=np.intp)
        return replace(ends(tracker, frame, measurement), seen=none, strictly=none)

    for index in range(16):
        with monkeypatch.context() as patch:
            if index < 2:
                patch.setattr(Tracker, "ends", no_ends)
            records.append(again.process(after.frame(index)))
        again.run_pending()
    assert told is not None and all(r.since_reference and r.since_reference.since_ns == told.since_ns for r in records)
    valid = [record for record in records if record.verdict is Verdict.VALID]
    assert len(valid) >= 10
    for record in valid:
        assert record.drift is not None and record.protection is not None
        error_m = np.linalg.norm(np.subtract(record.drift.tcp_shift_m, KNOCK_M))
        assert error_m < min(2e-4, record.protection.position_m)


def test_a_knock_is_a_change_for_the_state_file_once(monkeypatch: pytest.MonkeyPatch):
    """Not in each later frame that proves the new place, until a recalibration measures another reference."""
    monkeypatch.setattr(trust, "PROOF_EVERY_FRAMES", 1)
    pose, camera, gripper = nominal_cam_T_grip(), make_camera(PAPER_LENS), box_gripper(sharp=False)
    monitor = Monitor(camera, gripper, MonitorSettings(policy=BY_REFERENCE), reference_at(pose))
    simulator, changes = paper_rig(gripper, pose).simulator(scene(40, mount=(KNOCK,)), 2), []
    for index in range(36):
        monitor.process(simulator.frame(index))
        monitor.run_pending()
        changes.append(monitor._trust.since.changes)
    assert monitor._trust.since.current.knocked
    assert changes[KNOCKED - 1] < changes[KNOCKED + 5] == changes[-1]


@pytest.mark.parametrize("days", [0.0, 7.0])
def test_that_a_mount_stays_is_known_less_the_longer_ago_the_reference_is(days: float):
    kept = begun()
    kept.add(Mean(np.eye(4)), 0.03, 10**9)
    kept.now_ns = 10**9 + int(days * 86_400e9)
    assert kept.elapsed_s == days * 86_400.0 and not kept.current.knocked
    kept.now_ns = 0
    assert kept.elapsed_s == 0.0, "a clock that was set back"
    kept.moved()
    assert kept.current.knocked


def test_the_configured_reference_the_one_in_force_and_the_newest_are_kept():
    kept = begun()
    kept.measured(reference_at(np.eye(4)), Mean(np.eye(4)), 0.03)
    configured = kept.state()[0].reference_id
    for number in range(12):
        newer = msgspec.structs.replace(reference_at(np.eye(4)), reference_id=f"again-{number}")
        kept.measured(newer, Mean(np.eye(4)), 0.03)
    assert [each.reference_id for each in kept.state()] == [configured, *(f"again-{k}" for k in range(5, 12))]


def test_a_reference_that_is_measured_again_begins_it_from_its_own_frames_and_an_undo_goes_back():
    kept, anchor = begun(), Mean(np.eye(4), 40)
    for _ in range(FIRST_FRAMES):
        kept.add(anchor, 0.03, 1)
    there = Mean(moved(np.eye(4), np.array([2e-3, 0.0, 0.0, 0.0, 0.0, 0.0])), 20)
    new = msgspec.structs.replace(reference_at(there.cam_T_grip), reference_id="recalibration-2", stamp_ns=77)
    kept.measured(new, there, 0.02)
    kept.refer(new)
    at = kept.current
    assert at is not None and (at.since, at.since_ns, at.frames, at.jaw_opening_m) == (Since.REFERENCE, 77, 20, 0.02)
    undone = msgspec.structs.replace(reference_at(np.eye(4)), reference_id="undo-3", restores="factory-1")
    kept.refer(undone)
    assert kept.current is not None and kept.current.since is Since.FIRST_PROVED
    again = begun()
    assert again.restore(kept.state(), 1, 1) is None
    assert {each.reference_id for each in again.state()} == {"factory-1", "recalibration-2"}


# --- schema 1 ---


@pytest.mark.parametrize("name", ["transform", "transform_held", "transform_null"])
def test_records_of_schema_1_are_absolute(name: str):
    payload = (KEPT / f"{name}.json").read_bytes()
    assert b'"gripmon.transform/1"' in payload
    record = from_json(payload, FrameRecord)
    assert type(record) is FrameRecord and record.valid_by is ValidBy.ABSOLUTE and record.since_reference is None
    assert record.measured_T == record.cam_T_grip
    if record.protection is not None:
        assert record.absolute is not None and record.absolute.position_m == record.protection.position_m
    assert b'"gripmon.transform/2"' in to_json(record)


def test_a_reply_of_schema_1_is_read_with_its_snapshot():
    reply = from_json((KEPT / "reply_snapshot.json").read_bytes(), CommandReply)
    assert type(reply) is CommandReply and reply.snapshot is not None
    assert type(reply.snapshot.record) is FrameRecord and reply.snapshot.record.absolute is not None
