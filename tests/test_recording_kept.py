"""What stays: every image around an alert, the files that an alert pinned, and no more than the budget."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.recorded import (
    GRIPPER,
    INTERVAL_NS,
    OVERLAY,
    START_NS,
    Recorded,
    decoded,
    frame,
    image,
    record,
    recorder,
    scene,
    trace,
    wait_until,
)

from gripmon.model.records import Alert, AlertEvent, AlertKind, AlertRecord, Cause, Severity, State
from gripmon.record.files import FileSeries
from gripmon.record.keeping import Moments, Pinned, Trigger, claim, is_pinned, pin_path, pinned_by
from gripmon.record.pictures import PictureRing
from gripmon.record.recorder import Picture, RecordingSettings, Row
from gripmon.record.write import ProcessRecorder

BUMP = Alert(
    AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved by 4.5 mm", AlertEvent.RAISED, "1-abc", since_ns=1
)
SECOND = round(1e9 / INTERVAL_NS)  # frames


def own(alert: Alert, seq: int) -> AlertRecord:
    """An alert of the daemon's own, with a clock of its own."""
    return AlertRecord(
        robot="arm", camera="wrist", seq=seq, stamp_ns=START_NS + 10**18, state=State.STALE, reference_id="first",
        revision=1, **msgspec.structs.asdict(alert),
    )  # fmt: skip


def run_through(writer: ProcessRecorder, first: int, count: int, alerts: dict[int, Alert]) -> None:
    """Offer frames no faster than they are taken: nothing may be thinned for want of time."""

    def caught_up() -> bool:
        worker = writer._worker
        return worker is not None and not len(writer._frames) and worker.images_sent == writer._status.images_done

    for i in range(first, first + count):
        writer.frame(frame(i), record(i, alerts=(alerts[i],) if i in alerts else ()), partial(trace, i))
        if i % 4 == 0:
            wait_until(caught_up, timeout_s=60.0)


def files_in(directory: Path) -> list[Path]:
    return sorted(directory.glob("*.rrd"))


def test_every_image_around_an_alert_is_kept_and_few_elsewhere(tmp_path: Path) -> None:
    writer = recorder(tmp_path, image_rate_hz=2.0, around_alert_s=0.5, image_format="png", queue_images=64)
    bump, around_it = 80, SECOND // 2
    run_through(writer, 0, 160, {bump: BUMP})
    writer.close(60.0)
    assert (writer.dropped, writer.images_dropped) == (0, 0)
    (path,) = files_in(tmp_path)
    told = Recorded(path)
    shown = told.by_seq(OVERLAY, "blob")
    around = set(range(bump - around_it + 1, bump + around_it))
    assert around <= set(shown)
    elsewhere = sorted(set(shown) - set(range(bump - around_it, bump + around_it + 1)))
    assert 3 <= len(elsewhere) <= 8, "two a second"
    for i in (min(around), bump - 7, bump + 7, max(around)):
        np.testing.assert_array_equal(decoded(shown[i]), image(i))
    # The corners are drawn on each of them, and every image has its statistics.
    corners = told.by_seq(f"{OVERLAY}/corners/used", "positions")
    assert around <= set(corners) and len(corners[bump - 7]) == len(GRIPPER.corner_ids) - 1
    assert around <= set(told.by_seq("image/sharpness", "scalars"))
    assert told.seqs() == list(range(160))


def test_an_alert_of_the_daemon_s_own_keeps_the_images_before_it(tmp_path: Path) -> None:
    writer = recorder(tmp_path, image_rate_hz=0.0, around_alert_s=0.5, queue_images=64)
    run_through(writer, 0, 100, {})
    wait_until(lambda: writer.frames_written == 100)
    writer.event(own(Alert(AlertKind.SOURCE, Cause.NO_CAMERA, Severity.ERROR, "no frame for 5 s"), 99))
    writer.close(60.0)
    (path,) = files_in(tmp_path)
    # The first frame's image is there because the state was new with it.
    assert set(Recorded(path).by_seq(OVERLAY, "blob")) == {0, *range(100 - SECOND // 2, 100)}
    assert is_pinned(path)


def test_every_nth_image(tmp_path: Path) -> None:
    writer = recorder(tmp_path, image_rate_hz=0.0, image_every=7, around_alert_s=0.0, queue_images=64)
    run_through(writer, 0, 60, {})
    writer.close(60.0)
    (path,) = files_in(tmp_path)
    assert set(Recorded(path).by_seq(OVERLAY, "blob")) == set(range(0, 60, 7))


def test_every_image_for_exact_replay(tmp_path: Path) -> None:
    writer = recorder(tmp_path, image_rate_hz=0.0, image_every=1, image_format="png", queue_images=64)
    run_through(writer, 0, 60, {})
    writer.close(60.0)
    (path,) = files_in(tmp_path)
    told = Recorded(path).by_seq(OVERLAY, "blob")
    assert set(told) == set(range(60))
    np.testing.assert_array_equal(decoded(told[33]), image(33))


def pictured(i: int, size: int, stamp_ns: int | None = None) -> Row:
    made = record(i) if stamp_ns is None else record(i, stamp_ns=stamp_ns)
    return Row(made, Picture(bytes(size), "image/jpeg", 0.0, 0.0, 0.0, 0.0), None, None)


def test_the_ring_is_bounded_in_time_and_bytes() -> None:
    ring = PictureRing(span_ns=10 * INTERVAL_NS, limit_bytes=1000)
    for i in range(100):
        ring.push(pictured(i, 50))
        assert len(ring) <= 11 and ring.bytes == 50 * len(ring)
    for i in range(100, 200):
        ring.push(pictured(i, 300))
        assert ring.bytes <= 1000
    assert len(ring) == 3
    moments = Moments(INTERVAL_NS)
    moments.add(START_NS + 199 * INTERVAL_NS)
    assert [row.record.seq for row in ring.take(moments)] == [198, 199]
    assert (len(ring), ring.bytes) == (1, 300)
    ring.push(pictured(200, 5000))
    assert (len(ring), ring.bytes) == (0, 0), "one that is larger than all may be isn't kept either"
    ring.push(pictured(201, 10))
    ring.push(pictured(202, 10, START_NS))
    assert len(ring) == 1, "a clock that was set back"


def test_what_pins() -> None:
    trigger = Trigger()

    def by(event: AlertEvent, severity: Severity = Severity.WARNING, **changes: Any) -> bool:
        return trigger.by(msgspec.structs.replace(BUMP, event=event, severity=severity, **changes))

    assert by(AlertEvent.RAISED)
    assert not by(AlertEvent.UPDATED), "the same, once more"
    assert by(AlertEvent.UPDATED, Severity.ERROR), "it has become worse"
    assert not by(AlertEvent.CLEARED, Severity.INFO)
    assert by(AlertEvent.RAISED), "and again"
    assert not by(AlertEvent.RAISED, Severity.INFO, alert_id="2")
    assert by(AlertEvent.NOTED, alert_id="") and by(AlertEvent.NOTED, alert_id="")
    assert not by(AlertEvent.RAISED, kind=AlertKind.RECORDING, alert_id="3"), "about itself"
    for i in range(1000):
        by(AlertEvent.RAISED, alert_id=f"never cleared {i}")
    assert len(trigger._rank) <= 256


def series(directory: Path, name: str = "run", **changes: Any) -> FileSeries:
    made = FileSeries(scene(directory, name, **{"around_alert_s": 0.0, "max_file_bytes": 150_000, **changes}))
    made.write()  # begins the first file
    return made


def write(files: FileSeries, first: int, count: int, alarm: int | None = None, size: int = 100_000) -> None:
    """Frames one by one, a second of capture time apart, each with an incompressible picture."""
    for i in range(first, first + count):
        noise = Picture(os.urandom(size), "image/jpeg", 0.0, 0.0, 0.0, 0.0)
        stamp_ns = START_NS + i * 10**9
        files.add_frames([Row(record(i, stamp_ns=stamp_ns), noise, None, None)])
        if i == alarm:
            files.pin(pinned_by(BUMP, stamp_ns, i), stamp_ns)
        files.write()


def seqs_in(path: Path) -> list[int]:
    return Recorded(path).seqs()


def size_of(directory: Path) -> int:
    return sum(path.stat().st_size for path in directory.glob("*.rrd"))


def test_the_budget_takes_the_oldest_and_spares_what_is_pinned_and_others_files(tmp_path: Path) -> None:
    other = [tmp_path / "arm-wrist-2-20260101T000000Z-0001.rrd", tmp_path / "notes.rrd"]
    for path in other:
        path.write_bytes(bytes(500_000))
    files = series(tmp_path, "arm-wrist-20260101T000000Z")
    write(files, 0, 60, alarm=12)
    files.close()
    before = sorted(set(files_in(tmp_path)) - {*other})
    pinned = [path for path in before if is_pinned(path)]
    assert 0 < len(pinned) < len(before) / 2
    assert any(12 in seqs_in(path) for path in pinned)
    # Another run, as after a restart: only files speak.
    largest = max(path.stat().st_size for path in before)
    budget = int(sum(path.stat().st_size for path in pinned) / 0.9) + 8 * largest
    files = series(tmp_path, "arm-wrist-20260102T000000Z", budget_bytes=budget)
    seen: list[set[Path]] = []
    for i in range(100, 160, 10):
        write(files, i, 10)
        seen.append(set(files_in(tmp_path)))
        assert size_of(tmp_path) - 1_000_000 < budget + largest
    assert (files.failure, files.frames_lost) == (None, 0)
    files.close()
    for there in seen:
        assert {*other, *pinned} <= there
        gone = [path for path in before if path not in there and path not in pinned]
        assert gone == [path for path in before if path not in pinned][: len(gone)], "the oldest first"
    assert seen[-1] & {*before} == {*pinned}, "all that may go has gone"
    assert 159 in {seq for path in seen[-1] - set(before) - {*other} for seq in seqs_in(path)}


def test_the_pin_names_its_alert_and_reaches_before_and_after(tmp_path: Path) -> None:
    files = series(tmp_path, max_file_bytes=500_000, around_alert_s=7.0)
    write(files, 0, 60, alarm=30)
    files.close()
    pinned = set()
    for path in files_in(tmp_path):
        seqs = set(seqs_in(path))
        assert is_pinned(path) == bool(seqs & set(range(23, 38))), seqs
        pinned |= seqs if is_pinned(path) else set()
    assert set(range(23, 38)) <= pinned and len(pinned) < 25
    (of_alarm,) = [path for path in files_in(tmp_path) if 30 in seqs_in(path)]
    told = msgspec.json.decode(pin_path(of_alarm).read_bytes(), type=Pinned)
    (alert,) = told.alerts
    assert (alert.alert_id, alert.kind, alert.severity) == ("1-abc", AlertKind.STEP, Severity.WARNING)
    assert (alert.seq, alert.stamp_ns, alert.text) == (30, START_NS + 30 * 10**9, BUMP.text)
    assert not list(tmp_path.glob(".*")), "no leftovers of writing"


def test_recording_pauses_when_pinned_files_fill_the_budget_until_one_is_unpinned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gripmon.record.files._FIRST_RETRY_S", 0.0)
    files = series(tmp_path, budget_bytes=4_000_000, max_file_bytes=500_000)
    i = 0
    while files.failure is None:
        assert i < 200, "it never pauses"
        write(files, i, 1, alarm=i)
        i += 1
    assert files.failure.startswith(f"recording pauses: pinned recordings in {tmp_path} leave no room:")
    assert "nine tenths of budget_bytes 4 MB" in files.failure and ".pinned" in files.failure
    assert size_of(tmp_path) < 5_000_000
    lost = files.frames_lost
    write(files, i, 3)
    assert files.frames_lost == lost + 3
    kept = files_in(tmp_path)
    for path in kept[:3]:
        pin_path(path).unlink()
    write(files, i + 3, 3)
    assert files.failure is None and files.frames_lost == lost + 3
    files.close()
    assert not kept[0].exists() and kept[-1].exists()
    assert files_in(tmp_path)[-1].name > kept[-1].name, "numbers go on"


def test_pins_of_recordings_that_are_gone_go_with_the_next_start(tmp_path: Path) -> None:
    """Only those of this robot and camera, of earlier runs; the series' own keep its numbers."""
    gone, kept, other = (tmp_path / f"{name}.rrd" for name in (
        "arm-wrist-20260101T000000Z-0001", "arm-wrist-20260101T000000Z-0002", "arm-tool-20260101T000000Z-0001"
    ))  # fmt: skip
    own = tmp_path / "run-0007.rrd"
    kept.write_bytes(b"")
    for path in (gone, kept, other, own):
        pin_path(path).touch()
    series(tmp_path).close()
    assert sorted(path for path in (gone, kept, other, own) if is_pinned(path)) == sorted((kept, other, own))
    assert files_in(tmp_path)[-1].name == "run-0008.rrd"


def test_numbers_are_not_used_again(tmp_path: Path) -> None:
    files = series(tmp_path)
    write(files, 0, 5)
    files.close()
    *old, last = files_in(tmp_path)
    assert len(old) > 2
    for path in old:
        path.unlink()
    again = series(tmp_path)
    again.close()
    assert files_in(tmp_path)[-1].name == f"run-{int(last.stem[-4:]) + 1:04d}.rrd"


def test_files_roll_over_with_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("gripmon.record.files.time.monotonic", lambda: now[0])
    files = series(tmp_path, max_file_bytes=10_000_000, max_file_s=300.0)
    for i in range(12):
        write(files, i, 1, size=10)
        now[0] += 100.0
    now[0] += 10_000.0
    files.write()
    files.write()  # nothing new: no empty files for a camera that is away
    files.close()
    held = [seqs for seqs in map(seqs_in, files_in(tmp_path)) if seqs]
    assert held == [[0, 1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11]]
    assert len(files_in(tmp_path)) <= 5


def test_a_file_that_another_recorder_writes_is_not_deleted(tmp_path: Path) -> None:
    living = tmp_path / "arm-wrist-20260101T000000Z-0001.rrd"
    living.write_bytes(bytes(950_000))
    lock = claim(living)
    assert lock is not None
    files = series(tmp_path, budget_bytes=1_000_000)
    write(files, 0, 3)
    assert living.exists() and str(files.failure).startswith("recording pauses")
    files.close()
    os.close(lock)
    files = series(tmp_path, budget_bytes=1_000_000)
    write(files, 3, 3)
    files.close()
    assert not living.exists() and files.failure is None


def test_a_budget_of_less_than_four_files_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="budget_bytes 1000000 is less than four files"):
        msgspec.convert({"budget_bytes": 1_000_000, "max_file_bytes": 400_000}, RecordingSettings)
    assert msgspec.convert({"budget_bytes": 0}, RecordingSettings).budget_bytes == 0
