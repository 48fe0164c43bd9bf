"""Parts of the gripper can't be seen: an estimate with the covariance that it deserves, a held one, or none.

Plain pictures with sensor noise; what is hidden gets the background's grey and noise, as if it weren't there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.meters import box_gripper, difference, picture
from support.simulated import PAPER_LENS, nominal_cam_T_grip, plain_scenario
from support.watched import pose_of, reference_of

from gripmon.judge.policy import PolicySettings
from gripmon.model.camera import make_camera
from gripmon.model.records import AlertEvent, AlertKind, CornerFault, Frame, FrameRecord, Origin, State, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate.scenario import Sensor

SCENE = plain_scenario(sensor=Sensor())
BACKGROUND = 180
PERIOD_S = 0.05
WHOLE, HIDDEN, AGAIN = 6, 26, 8  # frames in which all shows, in which something is hidden, and after that
GATE = 22.46  # 99.9 % of chi-square with six degrees of freedom

MEASUREMENTS = ["edges"]

Mask = Callable[[np.ndarray], None]


def two_edges(shown: np.ndarray) -> None:
    """The sides of one finger, over a part of their length."""
    shown[370:470, :330] = True


def one_finger(shown: np.ndarray) -> None:
    shown[:, :384] = True


def roots(shown: np.ndarray) -> None:
    """Four long edges along the fingers, no corner."""
    shown[370:] = True


def far_parts(shown: np.ndarray) -> None:
    """All but the near corners and the edges between them: two corners are left."""
    shown[300:] = True


def tips(shown: np.ndarray) -> None:
    """The near corners, which lie on one line, and what is around them."""
    shown[:330] = True


def nothing(shown: np.ndarray) -> None:
    del shown


def run(mask: Mask, measurement: str = "edges", first: int = 0, frames: int = WHOLE + HIDDEN) -> list[FrameRecord]:
    """Frames of which those from ``WHOLE`` on, ``HIDDEN`` of them, show only what the mask leaves."""
    shown = np.zeros((PAPER_LENS.height_px, PAPER_LENS.width_px), dtype=bool)
    mask(shown)
    settings = MonitorSettings(measurement=measurement)  # type: ignore[arg-type]
    monitor = Monitor(make_camera(PAPER_LENS), box_gripper(), settings, reference_of(nominal_cam_T_grip()))
    records = []
    for i in range(first, frames):
        image = picture(SCENE, i % 20)
        if WHOLE <= i < WHOLE + HIDDEN:
            empty = np.random.default_rng(i).normal(BACKGROUND, 1.7, image.shape)
            image = np.where(shown, image, empty.round().astype(np.uint8))
        records.append(monitor.process(Frame(i, round(1e9 * PERIOD_S) * i, image, 0.034)))
    return records


def test_before_anything_is_proven_a_place_can_be_asked_for_its_sides():
    """A first frame that is displaced is held against the reference's place, when there is no anchor yet."""
    monitor = Monitor(
        make_camera(PAPER_LENS), box_gripper(), MonitorSettings(), reference_of(nominal_cam_T_grip())
    )  # fmt: skip
    frame, weigher = Frame(0, 0, picture(SCENE, 0), 0.034), monitor._trust._weigher
    measurement = monitor._tracker.measure_held(frame, nominal_cam_T_grip(), np.full(6, 1e-3))
    assert weigher.place.anchor is None and weigher.held_across(measurement, 0.0)


def covariance_of(record: FrameRecord) -> np.ndarray:
    return np.reshape(record.covariance, (6, 6))  # type: ignore[arg-type]


def error_of(record: FrameRecord) -> np.ndarray:
    return difference(pose_of(record.cam_T_grip), nominal_cam_T_grip())  # type: ignore[arg-type]


def honest(record: FrameRecord) -> bool:
    """No transform at all, or one whose error its covariance allows."""
    if record.cam_T_grip is None:
        return record.verdict is Verdict.UNKNOWN and record.covariance is None
    error = error_of(record)
    return float(error @ np.linalg.solve(covariance_of(record), error)) < GATE


# --- too little to go on ---


@pytest.mark.parametrize("measurement", MEASUREMENTS)
@pytest.mark.parametrize("mask", [two_edges, nothing])
def test_too_few_edges_are_held_with_a_growing_covariance_then_unknown(mask: Mask, measurement: str):
    records = run(mask, measurement)
    last, hidden = records[WHOLE - 1], records[WHOLE:]
    assert last.verdict is Verdict.VALID
    held = [r for r in hidden if r.cam_T_grip is not None]
    hold_s = PolicySettings().hold_s
    assert len(held) == round(hold_s / PERIOD_S) and held == hidden[: len(held)]
    sigma_m = [np.sqrt(covariance_of(r).diagonal()) for r in (last, *held)]
    for before, record, after in zip(sigma_m, held, sigma_m[1:], strict=False):
        assert (record.source, record.verdict, record.state) == (Origin.HELD, Verdict.SUSPECT, State.OCCLUDED)
        assert record.cam_T_grip == last.cam_T_grip and record.reason
        assert (after > before).all(), "less certain from frame to frame, in every direction"
        assert honest(record)
    for record in hidden[len(held) :]:
        assert (record.source, record.verdict, record.state) == (Origin.HELD, Verdict.UNKNOWN, State.LOST)
        assert record.cam_T_grip is record.covariance is record.smoothed is record.drift is record.rms_px is None
    assert {c.reason for r in hidden for c in r.corners} == {CornerFault.NO_FIT}
    alerts = [a for r in hidden for a in r.alerts]
    assert list(dict.fromkeys(a.kind for a in alerts)) == [AlertKind.OCCLUDED, AlertKind.LOST]
    assert [a.event for a in alerts].count(AlertEvent.RAISED) == 1, "what follows says why, and that it is lost"


def test_what_was_lost_is_found_again_when_it_shows():
    records = run(nothing, frames=WHOLE + HIDDEN + AGAIN)
    assert records[WHOLE + HIDDEN - 1].verdict is Verdict.UNKNOWN
    back = records[WHOLE + HIDDEN :]
    assert [r.source for r in back] == [Origin.UPDATE] * AGAIN
    assert {r.verdict for r in back[1:]} == {Verdict.VALID}
    assert all(honest(r) for r in back)


def test_a_gripper_that_never_showed_gives_no_transform():
    """Not even the reference: it was never seen to hold."""
    records = run(nothing, first=WHOLE)
    assert {r.verdict for r in records} == {Verdict.UNKNOWN}
    assert all(r.cam_T_grip is r.covariance is None for r in records)
    assert records[0].state is State.ACQUIRING and records[-1].state is State.LOST
    assert [a.kind for r in records for a in r.alerts] == [AlertKind.LOST]


# --- little, but enough ---


@pytest.mark.parametrize("measurement", ["edges", "corners"])
def test_with_one_finger_gone_the_estimate_goes_on_less_certain(measurement: str):
    records = run(one_finger, measurement)
    both, one = records[WHOLE - 1], records[WHOLE:]
    assert [r.source for r in one] == [Origin.UPDATE] * HIDDEN
    for record in one:
        # The bound needn't be larger than that of an early frame with both: what was proven before holds it.
        assert record.protection is not None and both.protection is not None
        assert both.protection.position_m > np.linalg.norm(error_of(both)[:3])
        assert record.protection.position_m > np.linalg.norm(error_of(record)[:3])
        assert honest(record)
        assert (covariance_of(record).diagonal() > covariance_of(both).diagonal()).all()
        assert np.sqrt(covariance_of(record)[0, 0]) > 2.0 * np.sqrt(covariance_of(both)[0, 0]), "x, along the axis"
        assert np.abs(error_of(record)[:3]).max() < 2e-4
        hidden = [corner for corner in record.corners if corner.id.startswith("R")]
        assert not any(corner.used for corner in hidden)


@pytest.mark.parametrize("mask", [roots, far_parts, tips])
@pytest.mark.parametrize("measurement", MEASUREMENTS)
def test_whatever_shows_the_covariance_covers_the_error(mask: Mask, measurement: str):
    records = run(mask, measurement)
    assert all(honest(r) for r in records)
    for record in records[WHOLE:]:
        if record.verdict is Verdict.VALID:
            assert np.abs(error_of(record)[:3]).max() < 2e-4
        if record.source is Origin.UPDATE:
            assert (covariance_of(record).diagonal()[:3] > covariance_of(records[WHOLE - 1]).diagonal()[:3]).any()
