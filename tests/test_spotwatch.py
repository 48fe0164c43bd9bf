"""A second camera watched by pulses of a laser, against simulated truth: false alarms, motions, causes, alerts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.pulsed_laser import AXES, calibration, drawn_world, poses, pulses, true_world

from gripmon.calibrate.sighting import NotFound
from gripmon.laser.judgement import SpotFault, SpotSeen, SpotWatchSettings
from gripmon.laser.planning import forecast
from gripmon.laser.spots import Spot, plain_spot
from gripmon.laser.watch import SpotWatch
from gripmon.laser.world import calibrated, predict
from gripmon.model.records import AlertEvent, AlertKind, Cause, Severity, State, Verdict


@pytest.fixture(scope="module")
def known():
    return calibrated(calibration())


def run(watch, stream):
    return [watch.judge(seen) for seen in stream]


def raised(judgements, kind=AlertKind.DRIFT):
    return [
        (k, alert)
        for k, judged in enumerate(judgements)
        for alert in judged.alerts
        if alert.event is AlertEvent.RAISED and alert.kind is kind
    ]


def first_alarm(known, change, seed, *, after=10, count=40, places=None, settings=None, wrong=0.0):
    """Pulses from the motion to the alarm (None: there was none), and the last judgement."""
    rng = np.random.default_rng(seed)
    truth = drawn_world(known, rng)
    where = poses()[: places or len(poses())]
    watch = SpotWatch(calibration(), settings)
    stream = pulses(truth, where, count, rng, moved=truth.moved(change), after=after, wrong=wrong)
    judged = run(watch, stream)
    alarms = raised(judged)
    assert not alarms or alarms[0][0] >= after, "an alarm before anything moved"
    return (alarms[0][0] - after + 1 if alarms else None), judged[-1], watch


@pytest.mark.parametrize(("places", "wrong"), [(None, 0.0), (3, 0.2)])
def test_false_alarms_are_no_more_frequent_than_stated(known, places, wrong):
    """Calibrations off by what they claim, an arm that is off by the same at a pose again and again: neither is
    mistaken for a motion, however many pulses there are.  10 in 1000 is the most that may be asked for.
    """
    settings = SpotWatchSettings(false_alarms_per_1000_pulses=10.0)
    rng = np.random.default_rng(7)
    alarms = 0
    for _ in range(4):
        truth = drawn_world(known, rng)
        watch = SpotWatch(calibration(), settings)
        where = poses()[: places or len(poses())]
        alarms += len(raised(run(watch, pulses(truth, where, 100, rng, wrong=wrong, arm=(1e-4, 2e-4)))))
    # Four are what 400 pulses may have: more than nine are rarer than 1 % then.
    assert alarms <= 9


def test_errors_that_pulses_have_in_common_are_not_counted_as_many(known):
    """A calibration that is off by two of its own standard deviations in the direction that spots show the most: 120
    pulses from one pose average their noise away, but not that.
    """
    pose = poses()[0]
    rows = predict(known.world, known.camera, pose).rows
    root = np.linalg.cholesky(known.covariance)
    worst = root @ np.linalg.svd(rows @ root)[2][0]
    watch = SpotWatch(calibration())
    judged = run(watch, pulses(known.world.moved(2.0 * worst), (pose,), 120, np.random.default_rng(1)))
    assert not raised(judged)
    assert watch.state is State.TRACKING
    assert np.mean([np.linalg.norm(j.off_px) for j in judged]) > 1.0 * np.linalg.norm(rows @ worst)


@pytest.mark.parametrize(
    ("change", "most"),
    [
        (1e-3 * AXES[0], 25), (np.radians(0.5) * AXES[4], 5), (5e-3 * AXES[8], 5), (np.radians(0.5) * AXES[9], 5),
        (np.radians(10.0) * AXES[4] + 0.03 * AXES[0], 8),
    ],
)  # fmt: skip
def test_motions_are_noticed_and_named(known, change, most):
    """A millimetre, half a degree, a fall: soon, and as what moved."""
    cause = (Cause.CAMERA_MOUNT, Cause.PLANE_MOVED, Cause.LASER_MOVED)[
        np.searchsorted([5, 8], np.flatnonzero(change)[0])
    ]
    for seed in (1, 2):
        delay, last, watch = first_alarm(known, change, seed, after=8, count=8 + most + 12)
        assert delay is not None and delay <= most
        assert last.causes[0].cause is cause and last.causes[0].probability > 0.9
        assert watch.book.about("motion").cause is cause
        assert last.state is State.DRIFTING and last.verdict is not Verdict.VALID


def test_the_camera_s_motion_is_estimated_as_exactly_as_it_claims(known):
    change = np.zeros(13)
    change[:6] = 3e-3, -2e-3, 1e-3, 4e-3, 6e-3, -3e-3
    squares = []
    for seed in range(6):
        _, last, _ = first_alarm(known, change, 100 + seed, after=5, count=45)
        motion = last.motion
        assert motion is not None and len(motion.observed) >= 5
        off = change[:6] - motion.shift
        squares.append(off @ np.linalg.solve(motion.covariance, off))
    # Six degrees of freedom, six times: the mean is 6 ± 1.4; noise is taken for no less than the residuals show.
    assert 0.5 < np.mean(squares) < 12.0


def test_one_orientation_does_not_tell_everything_and_says_so(known):
    """Spots on one pose: two numbers can't tell six, nor the camera from the pointer."""
    _, last, watch = first_alarm(known, np.radians(0.5) * AXES[3], 3, places=1)
    alert = watch.book.about("motion")
    assert alert.cause is Cause.UNKNOWN and "don't tell what moved" in alert.text
    assert {w.cause for w in alert.causes if w.probability > 0.1} >= {Cause.CAMERA_MOUNT, Cause.LASER_MOVED}
    assert sum(w.probability for w in alert.causes) == pytest.approx(1.0, abs=1e-4)
    assert last.motion is not None and not last.motion.complete and len(last.motion.observed) <= 2
    assert "hardly show a motion" in last.motion.text


def test_several_things_that_moved_at_once_are_not_called_one(known):
    change = np.array([2e-3, 2e-3, 2e-3, 8e-3, 8e-3, 8e-3, 5e-3, 5e-3, 3e-3, 8e-3, 8e-3, 3e-3, 3e-3])
    _, last, watch = first_alarm(known, change, 4)
    assert last.causes[0].cause is Cause.UNKNOWN and last.causes[0].probability > 0.9
    assert "alone" in watch.book.about("motion").text


def test_an_alert_is_raised_updated_acknowledged_and_cleared(known):
    rng = np.random.default_rng(6)
    truth = true_world()
    watch = SpotWatch(calibration())
    moved = truth.moved(np.radians(0.7) * AXES[3])
    judged = run(watch, pulses(truth, poses(), 30, rng, moved=moved, after=10))
    ((_, alert),) = raised(judged)
    assert alert.severity is Severity.ERROR and alert.tcp_shift_m is not None and alert.rotation_rad is not None
    assert np.linalg.norm(alert.tcp_shift_m) == pytest.approx(7e-3, rel=0.5)
    (seen,) = watch.book.acknowledge(alert.alert_id)
    assert seen.acknowledged and seen.alert_id == alert.alert_id and watch.book.acknowledge() == ()
    stream = (replace(s, stamp_ns=s.stamp_ns + 60 * 10**9) for s in pulses(truth, poses(), 25, rng))
    after = run(watch, stream)
    cleared = [a for j in after for a in j.alerts if a.event is AlertEvent.CLEARED]
    assert [a.alert_id for a in cleared] == [alert.alert_id]
    assert after[-1].state is State.TRACKING and after[-1].verdict is Verdict.VALID and not watch.book.open
    assert after[-1].motion is None and after[-1].probability_moved < 0.5


def test_an_open_alert_is_updated_when_the_motion_is_known_better(known):
    """The first pulses hardly tell it; whoever reads the alert alone must not be left with what they said."""
    rng = np.random.default_rng(12)
    moved = true_world().moved(np.radians(0.7) * AXES[3])
    watch = SpotWatch(calibration())
    judged = run(watch, pulses(true_world(), poses(), 60, rng, moved=moved, after=10))
    told = [(j.motion, a) for j in judged for a in j.alerts if a.event in (AlertEvent.RAISED, AlertEvent.UPDATED)]
    assert len(told) >= 2 and told[0][1].event is AlertEvent.RAISED
    (first, _), (last, alert) = told[0], told[-1]
    assert np.trace(last.covariance) < np.trace(first.covariance) / 4.0
    assert alert.text.endswith(last.text) and last.text != first.text
    sizes = [np.sqrt(np.linalg.eigvalsh(motion.covariance)[-1]) for motion, _ in told]
    assert len(told) <= 2 + np.log2(sizes[0] / sizes[-1]) and watch.motion_alert.text.endswith(judged[-1].motion.text)


def test_a_second_motion_after_the_first_is_followed(known):
    rng = np.random.default_rng(8)
    truth = true_world()
    watch = SpotWatch(calibration())
    first, both = truth.moved(5e-3 * AXES[8]), truth.moved(5e-3 * AXES[8] + np.radians(0.6) * AXES[4])
    run(watch, pulses(truth, poses(), 30, rng, moved=first, after=10))
    assert watch.book.about("motion").cause is Cause.PLANE_MOVED
    last = run(watch, pulses(both, poses(), 30, rng))[-1]
    assert last.state is State.DRIFTING and last.used
    assert last.causes[0].cause is Cause.CAMERA_MOUNT


@pytest.mark.parametrize("places", [3, 100])
def test_a_creep_is_noticed_and_not_taken_back_for_the_next_one(known, places):
    """0.1 mrad a pulse: what is believed since the calibration doesn't creep along."""
    rng = np.random.default_rng(17)
    truth, watch = true_world(), SpotWatch(calibration())
    judged = []
    for k in range(60):
        pose = poses()[k % places % len(poses())]
        crept = truth.moved(1e-4 * max(0, k - 10) * AXES[3])
        judged.append(watch.judge(replace(next(pulses(crept, (pose,), 1, rng)), stamp_ns=2_000_000_000 * k)))
    ((k, alert),) = raised(judged)
    assert 10 <= k < 40
    assert watch.state is State.DRIFTING and watch.book.about("motion").alert_id == alert.alert_id


def test_wrong_spots_raise_no_drift_and_are_said_to_be_wrong(known):
    rng = np.random.default_rng(9)
    watch = SpotWatch(calibration())
    judged = run(watch, pulses(true_world(), poses(), 100, rng, wrong=0.2))
    assert not raised(judged) and not raised(judged, AlertKind.LOST)
    wrong = [j for j in judged if not j.used]
    assert 8 <= len(wrong) <= 32
    assert all(j.fault is SpotFault.OUTLIER and "px from where it should be" in j.reason for j in wrong)
    assert all(j.verdict is not Verdict.VALID for j in wrong)


def test_a_reflection_that_outshines_the_spot_is_passed_over(known):
    watch = SpotWatch(calibration())
    rng = np.random.default_rng(10)
    for seen in pulses(true_world(), poses(), 30, rng):
        spot = seen.candidates[0]
        others = [Spot(rng.uniform(0, 470, 2), 1e-4 * np.eye(2), 1e5, 50) for _ in range(2)]
        judged = watch.judge(SpotSeen(seen.stamp_ns, seen.base_T_ee, [*others, spot]))
        assert judged.used and (judged.uv_px == spot.uv_px).all()
    assert watch.verdict is Verdict.VALID


def test_spots_that_stay_away_are_an_alert_of_their_own(known):
    watch = SpotWatch(calibration())
    stream = list(pulses(true_world(), poses(), 40, np.random.default_rng(11)))
    dark = [replace(s, candidates=NotFound("no spot: laser on?")) if 10 <= k < 30 else s for k, s in enumerate(stream)]
    judged = run(watch, dark)
    ((k, alert),) = raised(judged, AlertKind.LOST)
    assert k == 9 + watch.settings.pulses_until_lost and alert.severity is Severity.ERROR
    assert "laser off" in alert.text and judged[29].state is State.LOST and judged[29].verdict is Verdict.UNKNOWN
    assert judged[11].state is State.OCCLUDED and judged[10].fault is SpotFault.NO_SPOT
    assert not raised(judged)
    assert [a.event for j in judged[30:] for a in j.alerts] == [AlertEvent.CLEARED]
    assert judged[-1].state is State.TRACKING


def test_spots_all_over_the_place_are_told_as_that(known):
    rng = np.random.default_rng(12)
    watch = SpotWatch(calibration(), SpotWatchSettings(false_alarms_per_1000_pulses=0.01))
    run(watch, pulses(true_world(), poses(), 10, rng))
    judged = run(watch, pulses(true_world(), poses(), 25, rng, wrong=1.0))
    ((_, alert),) = raised(judged, AlertKind.LOST)
    assert "not where they should be" in alert.text and alert.cause is Cause.UNKNOWN


def test_poses_that_can_show_no_spot_say_nothing(known):
    watch = SpotWatch(calibration())
    run(watch, pulses(true_world(), poses(), 10, np.random.default_rng(13)))
    flat, away = poses()[0].copy(), poses()[0].copy()
    normal, direction = known.world.lit.normal_cam, known.world.lit.direction_ee
    along = np.cross(normal, [0.2, 0.9, 0.1])
    along /= np.linalg.norm(along)
    beam = flat[:3, :3] @ direction
    # The least turn that brings the beam into the plane.
    v, c = np.cross(beam, along), float(beam @ along)
    skewed = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    flat[:3, :3] = (np.eye(3) + skewed + skewed @ skewed / (1.0 + c)) @ flat[:3, :3]
    away[:3, 3] += [3.0, 0.0, 0.0]
    broken = np.full((4, 4), np.nan)
    for pose, fault in (
        (flat, SpotFault.NOT_FORESEEN),
        (away, SpotFault.NOT_FORESEEN),
        (broken, SpotFault.NOT_FINITE),
    ):
        for k in range(10):
            judged = watch.judge(SpotSeen(30_000_000_000 + k, pose, NotFound("no spot")))
            assert judged.fault is fault and judged.reason and not judged.alerts and not judged.used
    assert watch.state is State.TRACKING
    judged = watch.judge(SpotSeen(31_000_000_000, poses()[0], [plain_spot(np.array([np.nan, 3.0]))]))
    assert judged.fault is SpotFault.NO_SPOT


def test_it_begins_by_acquiring_and_can_begin_anew(known):
    watch = SpotWatch(calibration())
    assert (watch.state, watch.verdict) == (State.ACQUIRING, Verdict.UNKNOWN)
    rng = np.random.default_rng(14)
    moved = true_world().moved(np.radians(1.0) * AXES[3])
    judged = run(watch, pulses(true_world(), poses(), 4, rng))
    assert [j.state for j in judged[:2]] == [State.ACQUIRING, State.TRACKING]
    assert judged[0].verdict is Verdict.SUSPECT and judged[1].verdict is Verdict.VALID
    assert raised(run(watch, pulses(moved, poses(), 20, rng)))
    (cleared,) = watch.reset()
    assert cleared.event is AlertEvent.CLEARED and watch.state is State.ACQUIRING and not watch.book.open
    assert not raised(run(watch, pulses(true_world(), poses(), 20, rng)))


def test_the_same_pulses_give_the_same_judgements(known):
    def once():
        watch = SpotWatch(calibration())
        stream = pulses(
            true_world(), poses(), 25, np.random.default_rng(15), moved=true_world().moved(4e-3 * AXES[8]), after=8
        )
        return [
            (j.square, j.state, j.causes, j.probability_moved, [a.text for a in j.alerts]) for j in run(watch, stream)
        ]

    assert once() == once()


def test_a_single_spot_s_square_has_two_degrees_of_freedom(known):
    """Of truths and arms that are off by what is claimed; noise is what the calibration's residuals show."""
    rng = np.random.default_rng(16)
    squares = []
    for _ in range(40):
        watch = SpotWatch(calibration(), SpotWatchSettings(arm_noise_m=0.0, arm_noise_rad=0.0))
        squares += [j.square for j in run(watch, pulses(drawn_world(known, rng), poses()[:5], 5, rng))]
    # Five of each share a calibration: at worst 40 are independent.
    assert 2.0 - 4.0 * 2.0 / np.sqrt(40.0) < np.mean(squares) < 2.0 + 4.0 * 2.0 / np.sqrt(40.0)


@pytest.mark.parametrize(("index", "axis"), [(1, 0), (2, 2)])
def test_motions_are_noticed_about_as_soon_as_foreseen(known, index, axis):
    """What is foreseen is for pulses right after a calibration: those before the motion only help."""
    foreseen = forecast(known, SpotWatchSettings(), poses())
    size, promised = foreseen.sizes[index, axis], foreseen.pulses[index]
    change, count = size * AXES[axis], 5 + 3 * promised
    delays = [first_alarm(known, change, 200 + seed, after=5, count=count)[0] for seed in range(3)]
    assert all(delay is not None for delay in delays)
    assert np.median(delays) <= 2 * promised
    assert first_alarm(known, 0.1 * change, 300, after=5, count=5 + promised)[0] is None
