"""What a report says of runs whose every number is known."""

from __future__ import annotations

import base64
import html
import json
import re

import cv2
import msgspec
import numpy as np
import pytest
from support.loopback import state_record
from support.reported import FPS, NOISE_M, PERIOD_NS, REFERENCE, START_NS, Run, records, said, stepped

from gripmon.analyse.build import build
from gripmon.analyse.content import Report
from gripmon.analyse.correction import correct
from gripmon.analyse.page import _sentences, page
from gripmon.analyse.pictures import cut_alike
from gripmon.analyse.plots import LONGEST_NAME, Figure, overview_figure
from gripmon.analyse.summary import paragraph
from gripmon.analyse.words import duration
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    Cause,
    FrameRecord,
    RecordedConfiguration,
    Severity,
    Verdict,
    to_json,
)
from gripmon.model.records.recorded import RecordedFile
from gripmon.record.recordings import Picture

SECOND_NS = 1_000_000_000


def only(run: Run, **limits: float):
    report, _ = build([run], **limits)
    (recording,) = report.recordings
    return recording


def text_of(data: bytes) -> str:
    """What a person reads: without scripts, styles and tags."""
    markup = re.sub(r"(?s)<(script|style)\b.*?</\1>", " ", data.decode())
    plain = html.unescape(re.sub(r"<[^>]+>", " ", markup)).replace("\u00a0", " ")
    return re.sub(r"\s+", " ", plain)


def test_a_step_is_placed_at_its_frame_with_its_size_and_cause():
    recording = only(stepped())
    (event,) = recording.events
    assert event.kind == "step" and event.cause == "camera_mount_moved" and event.cause_probability == 0.9
    assert event.onset.stamp_ns == START_NS + 250 * PERIOD_NS
    assert event.onset.earliest_ns == START_NS + 249 * PERIOD_NS
    assert event.noticed_ns == START_NS + 253 * PERIOD_NS
    assert event.moved.size_m == pytest.approx(3e-3, abs=3e-6)
    assert event.moved.tcp_shift_m == pytest.approx((0.0, 3e-3, 0.0), abs=8e-6)
    (old,) = recording.affected
    assert (old.what, old.ended_by) == ("old_calibration", "end_of_recording")
    assert (old.start_ns, old.end_ns) == (START_NS + 250 * PERIOD_NS, START_NS + 499 * PERIOD_NS)
    assert old.largest.size_m == pytest.approx(3e-3, abs=1e-5)
    assert "moved once" in recording.summary and "still displaced" in recording.summary
    back, renew = "watch --mount --robot arm --camera wrist;", "gripmon send recalibrate --robot arm --camera wrist)"
    assert back in recording.summary and renew in recording.summary and "howto/put_back.md" in recording.summary
    assert recording.summary.endswith("(gripmon correct run-0001.rrd --out corrected.jsonl).")


def test_a_step_and_its_return_end_the_affected_time():
    shifts_m = np.zeros((600, 3))
    shifts_m[200:400, 0] = 1e-3
    run = records(shifts_m)
    said(run, 203)
    said(run, 420, event=AlertEvent.CLEARED, severity=Severity.INFO, text="the camera is where the reference has it")
    recording = only(Run(run))
    (old,) = recording.affected
    assert old.ended_by == "return"
    assert old.start_ns == START_NS + 200 * PERIOD_NS
    # A median over nine frames follows within half of them.
    assert abs(old.end_ns - (START_NS + 400 * PERIOD_NS)) <= 5 * PERIOD_NS
    assert "It has moved back" in recording.summary
    assert "What to do: correct what was recorded (gripmon correct run-0001.rrd" in recording.summary


@pytest.mark.parametrize("kept", [slice(0, 256), slice(0, 400, 20)], ids=["cut short after it", "few frames"])
def test_where_the_tcp_was_at_the_end_is_not_mixed_with_where_it_was_before(kept: slice):
    """It was said to have moved back where most of the last frames were from before the motion."""
    recording = only(Run(stepped().records[kept]))
    assert recording.at_end.size_m == pytest.approx(3e-3, abs=1e-5)
    assert "moved back" not in recording.summary and "displaced: when last measured" in recording.summary


@pytest.mark.parametrize("dropped", [False, True], ids=["unmeasured", "missing"])
def test_a_step_in_a_gap_affects_what_was_done_in_the_gap(dropped: bool):
    """It was said to affect the frames behind the gap alone."""
    shifts_m = np.zeros((500, 3))
    shifts_m[200:260] = np.nan
    shifts_m[260:] = (2e-3, 0.0, 0.0)
    run = records(shifts_m)
    said(run, 262)
    recording = only(Run(run[:200] + run[260:] if dropped else run))
    (old,) = [each for each in recording.affected if each.what == "old_calibration"]
    assert old.start_ns == START_NS + 200 * PERIOD_NS and old.limit_ns == START_NS + 260 * PERIOD_NS
    assert "Between 22:13:23.9 and 22:13:25.2 it moved, the TCP by 2.00 mm" in recording.summary
    assert "is affected from 22:13:24.0 " in recording.summary and ", by up to 2 mm)" in recording.summary


def test_of_frames_seconds_apart_each_counts():
    """Medians of nine were taken over half a minute: 1.2 mm for 3."""
    recording = only(Run(stepped(1600, 801).records[::160]))
    (event,) = [each for each in recording.events if each.kind == "step"]
    assert event.moved.size_m == pytest.approx(3e-3, abs=2e-5)
    (old,) = recording.affected
    assert old.largest.size_m == pytest.approx(3e-3, abs=2e-5) and old.limit_ns == START_NS + 960 * PERIOD_NS
    assert "Between 22:13:36.0 and 22:13:39.2 it moved, the TCP by 3.00 mm" in recording.summary


def test_what_was_not_seen_to_the_end_is_not_said_to_have_stood_still():
    shifts_m = np.zeros((500, 3))
    shifts_m[250:] = np.nan
    summary = only(Run(records(shifts_m))).summary
    assert "UTC) until it was last measured, at 22:13:24.9: no motion was reported in 5.0 s." in summary


def test_a_creep_begins_where_it_left_its_noise_and_lasts_until_it_rests():
    t = np.arange(1000) / FPS
    shifts_m = np.zeros((1000, 3))
    shifts_m[:, 1] = np.clip(t - 5.0, 0.0, 6.0) * 2e-4  # from 5 to 11 s by 1.2 mm
    run = records(shifts_m)
    said(run, 300, kind=AlertKind.DRIFT, severity=Severity.WARNING, cause=Cause.UNKNOWN, causes=())
    said(run, 400, kind=AlertKind.CREEP, event=AlertEvent.UPDATED, rate_m_per_min=0.012)
    (event,) = only(Run(run)).events
    assert event.kind == "creep" and event.severity == "error" and event.rate_m_per_min == 0.012
    assert event.cause == "camera_mount_moved"
    began_s = 1e-9 * (event.onset.stamp_ns - START_NS)
    assert began_s == pytest.approx(5.0, abs=0.15)
    assert event.onset.earliest_ns <= event.onset.stamp_ns <= event.onset.latest_ns
    assert event.moved.size_m == pytest.approx(1.2e-3, abs=1e-5)
    assert event.moved_in_s == pytest.approx(0.95 * 6.0, abs=0.2)
    since_s = 1e-9 * (event.noticed_ns - event.onset.earliest_ns)
    assert f"Noticed after at most {duration(since_s)}." in _sentences(event)


def test_two_steps_of_one_alert_are_two_events():
    shifts_m = np.zeros((800, 3))
    shifts_m[200:, 0] = 1e-3
    shifts_m[500:, 1] = 4e-3
    run = records(shifts_m)
    said(run, 204)
    said(run, 310, event=AlertEvent.UPDATED, text="measured better")
    said(run, 503, event=AlertEvent.UPDATED)
    first, second = only(Run(run)).events
    assert [round((e.onset.stamp_ns - START_NS) / PERIOD_NS) for e in (first, second)] == [200, 500]
    assert first.moved.size_m == pytest.approx(1e-3, abs=5e-6)
    assert second.moved.size_m == pytest.approx(4e-3, abs=5e-6)


@pytest.mark.parametrize("frames_left", [200, 3])
def test_a_new_reference_ends_the_old_ones_offset_not_the_calibrations(frames_left: int):
    """Also where the recording ends less than a second after it: the last second is of both references then."""
    run = stepped()
    changed = len(run.records) - frames_left
    renewed = msgspec.structs.replace(
        REFERENCE,
        reference_id="second",
        revision=2,
        cam_T_grip=msgspec.structs.replace(
            REFERENCE.cam_T_grip,
            translation_m=tuple(np.add(REFERENCE.cam_T_grip.translation_m, (0.0, 3e-3, 0.0)).tolist()),
        ),
        accepted_by="operator",
        parent="first",
    )
    for k in range(changed, len(run.records)):
        run.records[k] = msgspec.structs.replace(run.records[k], reference_id="second", revision=2)
    run.references = (REFERENCE, renewed)
    recording = only(run)
    ranges = {a.what: a for a in recording.affected}
    assert ranges["old_calibration"].ended_by == "end_of_recording"
    assert ranges["stale_reference"].ended_by == "recalibration"
    assert ranges["stale_reference"].end_ns == START_NS + changed * PERIOD_NS
    assert [r.reference_id for r in recording.references] == ["first", "second"]
    assert recording.references[1].step.size_m == pytest.approx(3e-3)
    assert recording.at_end.size_m == pytest.approx(3e-3, abs=1e-5)
    assert recording.at_end_against_reference.size_m < 2e-5
    assert "accepted by the operator" in recording.summary and "which holds" in recording.summary
    assert "gripmon watch --mount" in recording.summary and ", or use the new reference;" in recording.summary
    assert "gripmon send recalibrate" not in recording.summary


def test_the_error_of_a_configured_calibration_is_no_motion():
    configured = msgspec.structs.replace(
        REFERENCE, origin="configuration", covariance=tuple(np.diag([1e-7] * 3 + [1e-5] * 3).ravel().tolist())
    )
    off_m = np.tile([0.0, 5e-4, 0.0], (300, 1))  # 1.6 standard deviations
    recording = only(Run(records(off_m), references=(configured,)))
    assert not recording.affected and recording.at_end.size_m < 2e-5
    assert "did not move" in recording.summary
    # One that is measured is known better: the same shift is a motion.
    assert only(Run(records(off_m))).affected


def test_a_knock_among_the_first_frames_is_no_error_of_the_calibration():
    """Nor half of one: the camera stands 1 mm away at the end, from the frame of the knock on."""
    configured = msgspec.structs.replace(
        REFERENCE, origin="configuration", covariance=tuple(np.diag([1e-7] * 3 + [1e-5] * 3).ravel().tolist())
    )
    made = records(np.where(np.arange(300)[:, None] < 10, 0.0, [0.0, 1e-3, 0.0]))
    said(made, 13)
    recording = only(Run(made, references=(configured,)))
    assert recording.at_end.size_m == pytest.approx(1e-3, abs=2e-5)
    assert recording.affected[0].start_ns == START_NS + 10 * PERIOD_NS


def test_a_displaced_camera_of_which_no_motion_was_reported_is_not_said_to_stand():
    """As from the first frame on, or after a knock that the frames show but none of them proves."""
    summary = only(Run(records(np.tile([0.0, 3e-3, 0.0], (300, 1))))).summary
    assert "No motion of the camera of arm / wrist was reported" in summary and "did not move" not in summary
    assert "It is displaced: when last measured" in summary and "3 mm" in summary


def test_a_displacement_that_another_background_would_look_like_may_be_one():
    """As on stills of a real gripper that nobody touched: a millimetre where steps of seven may be missing."""
    recording = only(Run(records(np.tile([0.0, 1e-3, 0.0], (300, 1)))))
    told = paragraph(msgspec.structs.replace(recording, missable_m=0.9e-3))
    assert "It is displaced: when last measured" in told and "calibration is affected" in told
    told = paragraph(msgspec.structs.replace(recording, missable_m=7.1e-3))
    assert "It may be displaced: when last measured" in told and "calibration may be affected" in told
    assert "by up to 7.1 mm another background would look the same" in told
    assert "What to do" not in told
    turned = msgspec.structs.replace(recording.at_end, size_m=0.0, rotation_rad=0.09)
    told = paragraph(msgspec.structs.replace(recording, missable_m=7.1e-3, at_end=turned))
    assert "It is displaced" in told and "calibration is affected" in told
    (old,) = [a for a in recording.affected if a.what == "old_calibration"]
    far = msgspec.structs.replace(old, largest=msgspec.structs.replace(old.largest, size_m=8e-3))
    told = paragraph(msgspec.structs.replace(recording, missable_m=7.1e-3, affected=(far,)))
    assert "calibration is affected" in told and "may be" not in told


def test_before_a_motion_nothing_is_affected_by_what_a_frame_cannot_tell():
    """A shift past the limit along an axis that frames know less well than that; then a knock."""
    run = stepped()
    sigmas = np.array([1e-5, 1e-5, 1.5e-4, 1e-3, 1e-3, 1e-3])
    for k, record in enumerate(run.records):
        pose = record.cam_T_grip
        x, y, z = pose.translation_m
        run.records[k] = msgspec.structs.replace(
            record,
            cam_T_grip=msgspec.structs.replace(pose, translation_m=(x, y, z + 1.6e-4)),
            covariance=tuple(np.diag(sigmas**2).ravel().tolist()),
        )
    (old,) = only(run).affected
    assert old.start_ns == START_NS + 250 * PERIOD_NS and old.end_ns == START_NS + 499 * PERIOD_NS
    # Frames that know it are believed.
    sure = tuple(np.diag((0.1 * sigmas) ** 2).ravel().tolist())
    run.records[:] = [msgspec.structs.replace(record, covariance=sure) for record in run.records]
    assert only(run).affected[0].start_ns == START_NS


def test_images_without_time_stamps_are_given_no_date():
    shifts_m = np.zeros((100, 3))
    assert "by a clock that began with the images" in only(Run(records(shifts_m, start_ns=0))).summary
    assert "2023-11-14" in only(Run(records(shifts_m))).summary


def test_what_was_lost_is_told():
    run = stepped(at=450)
    run.records[100:200] = [
        msgspec.structs.replace(r, verdict=Verdict.UNKNOWN, cam_T_grip=None, covariance=None, drift=None)
        for r in run.records[100:200]
    ]
    del run.records[300:400]
    recording = only(run)
    unknown = next(a for a in recording.affected if a.what == "unknown")
    assert (unknown.start_ns, unknown.end_ns) == (START_NS + 100 * PERIOD_NS, START_NS + 200 * PERIOD_NS)
    gap = next(e for e in recording.events if e.kind == "gap")
    assert gap.end_ns - gap.onset.stamp_ns == 101 * PERIOD_NS and "100 frames" in gap.story[0].text
    assert recording.running.frames_dropped == 100
    assert recording.running.gaps == 1
    assert "for 2.0 s there was no transform" in recording.summary
    assert "100 frames (20 %) are missing" in recording.summary
    few = "Only 300 of 500 frames were measured (100 missing, 100 in which nothing could be measured): "
    assert recording.summary.startswith(few)


GAP, DAMAGE = "run-0001.rrd: 40 frames of the run are missing", "run-0001.rrd: has 1 damaged message"


@pytest.mark.parametrize(
    ("faults", "monitor", "recorder", "dropped"),
    [
        ((GAP,), 0, 0, True),
        ((GAP,), 30, 10, True),
        ((GAP, DAMAGE), 30, 10, True),
        ((GAP, DAMAGE), 30, 9, False),
        ((GAP, DAMAGE), 0, 0, False),
    ],
)
def test_frames_that_were_dropped_are_no_damage(faults: tuple[str, ...], monitor: int, recorder: int, dropped: bool):
    run = stepped(faults=faults, gaps=(GAP,))
    del run.records[300:340]
    state = msgspec.structs.replace(state_record(), frames_dropped=monitor, recording_dropped=recorder)
    run.states = (state,)
    report, told = build([run])
    (recording,) = report.recordings
    assert recording.running.frames_dropped == 40
    assert recording.running.dropped == ((GAP,) if dropped else ())
    assert recording.faults == tuple(fault for fault in faults if not (dropped and fault == GAP))
    text = text_of(page(report, told))
    assert ("What of this recording could not be used" in text) == bool(recording.faults)
    assert text.index(GAP) > text.index("How the monitor ran") if dropped else text.index(GAP) < text.index("Drift of")


def test_noise_rate_latency_and_shares_are_those_of_the_frames():
    running = only(stepped(n=2000)).running
    assert running.noise.position_m == pytest.approx(NOISE_M, rel=0.1)
    assert running.noise.claimed_position_m == pytest.approx((1e-5, 2e-5, 3e-5))
    assert running.frames_per_s == pytest.approx(FPS)
    latencies_s = 1e-9 * (2_000_000 + 1000 * np.arange(2000))
    assert running.latency_median_s == pytest.approx(np.median(latencies_s))
    assert running.latency_p99_s == pytest.approx(np.percentile(latencies_s, 99))
    assert [(s.name, s.frames) for s in running.verdicts] == [("valid", 2000)]
    assert sum(s.frames for s in running.slices) == 2000


def test_limits_come_from_the_recorded_configuration_or_from_the_command():
    text = "monitor:\n  policy:\n    warn_m: 0.005\n    limit_m: 0.02\n"
    configuration = RecordedConfiguration("main.yaml", {"main.yaml": RecordedFile(text)})
    run = stepped(configuration=configuration)
    assert only(run).limits.affected_m == 0.005
    assert not only(run).affected, "3 mm are within 5 mm"
    assert only(run, affected_m=1e-3).affected
    broken = stepped(configuration=RecordedConfiguration("main.yaml", {"main.yaml": RecordedFile("a: [")}))
    assert only(broken).limits.affected_m == 1e-4
    assert "can't be read" in only(broken).limits.origin


def test_time_that_runs_backwards_is_straightened_and_told():
    run = stepped()
    run.records[300:] = [msgspec.structs.replace(r, stamp_ns=r.stamp_ns - 60 * SECOND_NS) for r in run.records[300:]]
    recording = only(run)
    assert any("runs backwards by 59.980 s at frame 300" in fault for fault in recording.faults)
    assert recording.end_ns - recording.start_ns == 499 * PERIOD_NS
    assert recording.events[0].onset.stamp_ns == START_NS + 250 * PERIOD_NS


def test_several_robots_stand_on_one_axis_and_by_themselves():
    later = records(np.zeros((100, 3)), start_ns=START_NS + 3600 * SECOND_NS)
    report, told = build([Run(later, robot="other", recording_id="run-2"), stepped()])
    assert [r.robot for r in report.recordings] == ["arm", "other"]
    assert report.summary.startswith("2 recordings of 2 cameras; the camera moved in 1 of them. arm / wrist moved once")
    assert "at the end its TCP is 3 mm off" in report.summary
    shown = page(report, told)
    assert b'id="data-overview"' in shown and b'id="recording-2"' in shown
    assert "The camera of other / wrist did not move" in text_of(shown)


def test_long_names_leave_the_plot_its_room_and_stay_apart():
    """Beside the plot of all recordings they took the whole width of a telephone."""
    names = ["production_line_three_west_wing_cell_0012_left", "production_line_three_east_wing_cell_0012_left"]
    report, _ = build([stepped(robot=name) for name in names])
    drawn = json.loads(overview_figure(report.recordings).json())
    strips = [trace["y"][0] for trace in drawn["data"] if trace["yaxis"] == "y2"]
    axis = drawn["layout"]["yaxis2"]
    assert sorted(set(strips)) == sorted(f"{name} / wrist" for name in names) == sorted(axis["tickvals"])
    assert {len(text) for text in axis["ticktext"]} == {LONGEST_NAME} and axis["ticktext"][0].endswith("left / wrist")


def test_empty_runs_and_runs_without_a_measurement_are_told():
    blind = Run(records(np.full((50, 3), np.nan)), robot="blind")
    report, told = build([Run([], robot="nobody"), blind])
    assert "no frame could be read" in next(r for r in report.recordings if r.robot == "nobody").summary
    assert "in no frame" in next(r for r in report.recordings if r.robot == "blind").summary
    assert b"nobody / wrist" in page(report, told)


def test_hostile_texts_stay_texts():
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&amp;"
    run = stepped(robot=evil, faults=(evil,))
    said(run.records, 260, kind=AlertKind.IMAGE, text=evil, alert_id="2-b", part=evil, cause=Cause(evil))
    run.references = (msgspec.structs.replace(REFERENCE, accepted_by=evil),)
    report, told = build([run, stepped(robot="plain")], (evil,))
    shown = page(report, told).decode()
    assert evil not in shown and "<img src=x" not in shown
    assert shown.count("<script") == shown.count("</script>"), "nothing ends a script before its end"
    assert evil in text_of(shown.encode())


def test_the_data_are_what_the_page_shows_and_come_back_from_json():
    report, told = build([stepped()])
    again = msgspec.json.decode(to_json(report), type=Report)
    assert again == report
    recording = again.recordings[0]
    shown = text_of(page(report, told))
    assert re.sub(r"\s+", " ", again.summary) in shown
    event, old = recording.events[0], recording.affected[0]
    for stamp_ns in (event.onset.stamp_ns, old.start_ns, old.end_ns):
        assert str(np.datetime64(stamp_ns, "ns"))[11:21] in shown
    assert f"{1e3 * event.moved.size_m:.2f}" in shown and "camera's mount moved (90 %)" in shown
    assert (
        re.findall(r"(?:https?:)?//[\w.]+", re.sub(r"(?s)<script\b.*?</script>", "", page(report, told).decode())) == []
    )


def test_a_long_run_is_short_on_the_page_and_loses_no_outlier():
    """Longer than what is looked back on as a whole."""
    n, wild, step = 21_000, 6_345, 15_000
    shifts_m = np.zeros((n, 3))
    shifts_m[wild, 0] = 2e-3
    shifts_m[step:, 1] = 1e-3
    run = records(shifts_m)
    said(run, step + 2)
    recording = only(Run(run))
    assert len(recording.affected) == 1, "one frame affects nothing"
    x = next(c for c in recording.curves if c.name == "x_m")
    assert len(x.stamp_ns) < 4000
    assert max(x.high) == pytest.approx(2e-3, abs=1e-4)
    near = [t for t in x.stamp_ns if abs(t - (START_NS + step * PERIOD_NS)) <= SECOND_NS]
    assert len(near) == 2 * FPS + 1, "around a motion every frame is there"


@pytest.mark.parametrize("seed", range(12))
def test_whatever_a_run_holds_there_is_a_report(seed: int):
    """Frames with holes, wild clocks, covariances of zero, references no one has, alerts in any order."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 120)) if seed % 3 else int(rng.integers(1, 6))
    shifts_m = np.cumsum(rng.normal(size=(n, 3)) * (0.0, 1e-6, 1e-3)[seed % 3], axis=0)
    shifts_m[rng.random(n) < 0.5 * rng.random()] = np.nan
    run = records(shifts_m, seed)
    for _ in range(6):
        said(
            run,
            int(rng.integers(n)),
            kind=list(AlertKind)[rng.integers(len(AlertKind))],
            event=list(AlertEvent)[rng.integers(4)],
            severity=list(Severity)[rng.integers(3)],
            alert_id=("", "1", "2")[rng.integers(3)],
            since_ns=(None, 5, 2**62)[rng.integers(3)],
        )
    if seed % 4 == 1:
        run = [msgspec.structs.replace(r, stamp_ns=int(rng.integers(-(2**62), 2**62))) for r in run]
    if seed % 4 == 2:
        run = [msgspec.structs.replace(r, revision=int(rng.integers(-1, 2))) for r in run if rng.random() < 0.7]
    if seed % 5 == 3:
        run = [msgspec.structs.replace(r, covariance=(0.0,) * 36 if r.covariance else None) for r in run]
    report, told = build([Run(run, references=(REFERENCE,) * (seed % 2), image_seqs=np.arange(0, 200, 3))])
    assert msgspec.json.decode(to_json(report), type=Report).recordings[0].running.frames == len(run)
    assert report.summary and (seed % 8 or page(report, told))


def repeated(*frames: FrameRecord) -> list[FrameRecord]:
    """Thirty times each, to the last digit."""
    every = [frame for frame in frames for _ in range(30)]
    return [msgspec.structs.replace(f, seq=i, stamp_ns=START_NS + i * PERIOD_NS) for i, f in enumerate(every)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("frames", ["one", "two", "no_covariance", "far_away", "all_far_away"])
def test_frames_that_have_no_noise_or_no_place_are_looked_back_on(frames: str):
    first, moved = records(np.array([[0.0, 0.0, 0.0], [0.0, 3e-3, 0.0]]))
    far = msgspec.structs.replace(moved.cam_T_grip, translation_m=(1e160, 0.0, 0.1))
    far_away = msgspec.structs.replace(moved, cam_T_grip=far)
    run = {
        "one": repeated(first),
        "two": repeated(first, moved),
        "no_covariance": repeated(msgspec.structs.replace(first, covariance=(0.0,) * 36)),
        "far_away": repeated(first, far_away, first),
        "all_far_away": repeated(far_away),
    }[frames]
    source = Run(run)
    table = source.frames
    matrices, measured = table.matrices(), np.isfinite(table.cam_T_grip).all(axis=1)
    if frames in ("no_covariance", "all_far_away"):
        with pytest.raises(ValueError, match=r"30 frames.* not used"):
            correct(table.stamp_ns, matrices, table.covariance, measured)
    else:
        made = correct(table.stamp_ns, matrices, table.covariance, measured)
        assert np.isfinite(made.cam_T_grip).all() and np.isfinite(made.covariance).all()
        assert [point.index for point in made.change_points] == ([30] if frames == "two" else [])
        assert bool(made.faults) == (frames == "far_away")


def test_a_step_between_frames_without_noise_is_an_event():
    first, moved = records(np.array([[0.0, 0.0, 0.0], [0.0, 3e-3, 0.0]]))
    (event,) = only(Run(repeated(first, moved))).events
    assert event.onset.found_by == "hindsight" and event.moved.size_m == pytest.approx(3e-3, rel=0.02)
    assert event.onset.earliest_ns <= START_NS + 30 * PERIOD_NS <= event.onset.latest_ns


def test_a_clock_that_jumps_by_years_stretches_nothing():
    run = stepped()
    year_ns = 365 * 86400 * SECOND_NS
    run.records[300:] = [msgspec.structs.replace(r, stamp_ns=r.stamp_ns + year_ns) for r in run.records[300:]]
    recording = only(run)
    assert any("jumps ahead by 31536000 s at frame 300" in fault for fault in recording.faults)
    assert recording.end_ns - recording.start_ns == 499 * PERIOD_NS


def test_a_step_that_no_alert_told_of_is_found_afterwards():
    shifts_m = np.zeros((800, 3))
    shifts_m[500:, 1] = 1e-3
    (event,) = only(Run(records(shifts_m))).events
    assert event.kind == "step" and event.noticed_ns is None and event.onset.found_by == "hindsight"
    assert event.onset.earliest_ns <= START_NS + 500 * PERIOD_NS <= event.onset.latest_ns
    assert event.moved.size_m == pytest.approx(1e-3, abs=1e-5)


def test_a_drift_that_was_one_step_is_placed_at_its_change_point():
    """Noticed two seconds late, when nothing was certain at the time: afterwards the frames show when it was."""
    shifts_m = np.zeros((500, 3))
    shifts_m[200:, 1] = 9e-4
    run = records(shifts_m)
    rng = np.random.default_rng(1)
    for i in range(200, 260):  # what was measured meanwhile is wild
        wild = records(np.array([shifts_m[i] + rng.normal(size=3) * 8e-4]), seed=i)[0]
        run[i] = msgspec.structs.replace(run[i], cam_T_grip=wild.cam_T_grip, drift=wild.drift, verdict=Verdict.SUSPECT)
    said(run, 300, kind=AlertKind.DRIFT, severity=Severity.WARNING)
    recording = only(Run(run))
    (event,) = recording.events
    assert event.kind == "step" and event.onset.found_by == "hindsight"
    assert abs(event.onset.stamp_ns - (START_NS + 200 * PERIOD_NS)) <= 0.4 * SECOND_NS, "frames are wild until 260"
    assert event.moved.size_m == pytest.approx(9e-4, rel=0.2)
    (old,) = [a for a in recording.affected if a.what == "old_calibration"]
    assert event.onset.earliest_ns <= old.start_ns <= event.onset.latest_ns and "it moved at once" in recording.summary


def test_a_drift_that_takes_its_time_stays_one_and_its_times_off_do_not_overlap():
    t = np.arange(1000) / FPS
    shifts_m = np.zeros((1000, 3))
    shifts_m[:, 1] = np.clip(t - 5.0, 0.0, 6.0) * 2e-4
    shifts_m[450:500, 1] = 2e-5  # for a second nearly back, and out again
    run = records(shifts_m)
    said(run, 400, kind=AlertKind.DRIFT, severity=Severity.WARNING)
    report, told = build([Run(run)])
    (recording,) = report.recordings
    assert [event.kind for event in recording.events][:1] == ["drift"]
    old = [a for a in recording.affected if a.what == "old_calibration"]
    assert len(old) == 2 and old[0].end_ns <= old[1].start_ns
    within_s = 1e-9 * sum(a.end_ns - a.start_ns for a in old)
    assert within_s < 1e-9 * (recording.end_ns - old[0].start_ns) - 0.5
    assert f"Old calibration off {within_s:.1f} s" in text_of(page(report, told))


def test_a_motion_has_pictures_before_it_at_it_and_after_it():
    run = stepped(image_seqs=np.arange(0, 500, 10))
    for i in range(250, 285):
        run.records[i] = msgspec.structs.replace(run.records[i], verdict=Verdict.SUSPECT)
    (event,) = only(run).events
    assert (event.before_seq, event.at_seq, event.after_seq) == (240, 250, 290)


def test_missing_frames_are_said_first_and_count_as_not_valid():
    """27 of 1,188 frames, all valid: neither "valid 100 %" nor nothing said."""
    run = stepped(n=1188, at=600)
    run.records[:] = [run.records[i] for i in sorted({*range(0, 1188, 46), 1187})]
    recording = only(run)
    assert len(run.records) == 27 and recording.running.frames_dropped == 1161
    assert recording.summary.startswith("Only 27 of 1188 frames were measured (1161 missing): the figures mean little.")
    assert recording.integrity.valid == pytest.approx(27 / 1188)
    report, told = build([run])
    assert "Valid, of all frames 2.3 %" in text_of(page(report, told)) and "27 frames of 1188" in text_of(
        page(report, told)
    )
    few = stepped(n=1000)
    del few.records[300:303]
    assert only(few).summary.startswith("3 frames (0.3 %) are missing. The camera")


def test_a_size_has_no_uncertainty_that_leaves_light_and_bevels_out():
    report, told = build([stepped()])
    assert "±" not in text_of(page(report, told)) and "±" not in report.summary
    assert report.recordings[0].events[0].moved.sigma_m is not None, "the frames' noise is in the data"


def test_how_large_a_step_may_be_missing_is_told():
    """The frames' covariance allows 9.3 times 30 µm between two backgrounds; nobody is told that nothing moved."""
    report, told = build([Run(records(np.zeros((300, 3))))])
    assert report.recordings[0].missable_m == pytest.approx(9.3 * 3e-5, rel=0.02)
    assert f"Steps may be missing up to {1e3 * report.recordings[0].missable_m:.3g} mm" in text_of(page(report, told))
    assert only(Run(records(np.full((50, 3), np.nan)))).missable_m is None


def test_the_picture_of_a_creep_shows_it():
    t = np.arange(1000) / FPS
    shifts_m = np.zeros((1000, 3))
    shifts_m[:, 1] = np.clip(t - 5.0, 0.0, 6.0) * 2e-4
    run = records(shifts_m)
    said(run, 400, kind=AlertKind.CREEP)
    (event,) = only(Run(run, image_seqs=np.arange(0, 1000, 10))).events
    way = [shifts_m[seq, 1] for seq in (event.before_seq, event.at_seq, event.after_seq)]
    assert way[0] < 5e-5 and 0.45 * way[2] < way[1] < 0.65 * way[2]


def test_what_is_not_used_is_not_shown_in_green():
    points = np.stack([np.arange(20.0, 300.0, 4.0), np.full(70, 100.0)], axis=1).astype(np.float32)
    picture = Picture(7, START_NS, np.zeros((240, 320), np.uint8), points, points[:0], (points[:2],), ())
    green = []
    for used in (True, False):
        (shown,) = cut_alike([picture], [used])
        data = np.frombuffer(base64.b64decode(shown.uri.partition(",")[2]), np.uint8)
        blue, middle, red = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int).transpose(2, 0, 1)
        green.append(int((middle - np.maximum(blue, red) > 60).sum()))
    assert green[0] > 200 and green[1] == 0


def test_times_in_the_first_seconds_of_1970_are_no_years():
    """Images without capture times are counted from there; Plotly takes 1000 for the year."""
    for seconds, expected in ((1.0, "1970-01-01T00:00:01.000000000"), (1_790_000_000.0, 1_790_000_000_000.0)):
        figure = Figure(300, (("y", 1.0),))
        figure.add(1, np.array([1e3 * seconds, np.nan]), [0.0, 1.0], "line")
        figure.mark(round(1e9 * seconds), 1, "mark", "#000000", "dash")
        drawn = json.loads(figure.json())
        assert drawn["data"][0]["x"] == [expected, None]
        assert drawn["layout"]["shapes"][0]["x0"] == drawn["layout"]["annotations"][0]["x"] == expected
