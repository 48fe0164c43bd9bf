"""``gripmon replay``: one line for every frame, in order, the same bytes each time; nothing stops it half-way."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.gripmon_process import GRIPMON
from support.loopback import frame_record

from gripmon.cli import main
from gripmon.daemon.replaying import Counts
from gripmon.model.records import Beside, Frame, FrameRecord, Origin, Refusal
from gripmon.monitor import Monitor

ROOT = Path(__file__).resolve().parent.parent
CONTRACT = {
    "seq", "stamp_ns", "verdict", "state", "source", "cam_T_grip", "covariance", "smoothed", "drift", "reference_id",
    "revision", "rms_px", "jaw_opening_m", "corners", "alerts", "latency_ns", "protection",
}  # fmt: skip
FPS = 10


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a camera that a cable pulls aside."""
    out = tmp_path_factory.mktemp("simulated") / "creep"
    assert main(["simulate", "creep", "--out", str(out), "--seconds", "2", "--fps", str(FPS), "--seed", "2"]) == 0
    return out


@pytest.fixture
def copied(sequence: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sequence, tmp_path / "copied"))


def replayed(source: Path, out: Path, *options: str, config: Path | None = None, code: int = 0) -> list[dict[str, Any]]:
    """The lines that replaying ``source`` gives."""
    config = source / "config.yaml" if config is None else config
    assert main(["replay", str(source), "--config", str(config), "--out", str(out), *options]) == code
    return [json.loads(line) for line in out.read_bytes().splitlines()]


def without_latency(path: Path) -> bytes:
    return re.sub(rb'"latency_ns":\d+', b"", path.read_bytes())


def test_one_line_for_every_frame_in_order_with_all_fields(sequence: Path, tmp_path: Path):
    lines = replayed(sequence, tmp_path / "out.jsonl")
    truths = [json.loads(line) for line in (sequence / "truth.jsonl").read_text().splitlines()]
    assert [line["name"] for line in lines] == [t["file"] for t in truths]
    assert [line["stamp_ns"] for line in lines] == [t["stamp_ns"] for t in truths]
    assert [line["seq"] for line in lines] == list(range(len(truths)))
    assert all(line.keys() >= CONTRACT for line in lines)
    assert all(line["latency_ns"] > 0 for line in lines)


def test_the_transforms_follow_the_truth(sequence: Path, tmp_path: Path):
    lines = replayed(sequence, tmp_path / "out.jsonl")
    truths = [json.loads(line) for line in (sequence / "truth.jsonl").read_text().splitlines()]
    assert np.linalg.norm(truths[-1]["tcp_shift_m"]) > 1e-3
    measured = [(line, t) for line, t in zip(lines, truths, strict=True) if line["verdict"] == "valid"]
    assert len(measured) > 0.6 * len(lines)
    errors_m = np.array(
        [np.subtract(line["cam_T_grip"]["translation_m"], np.array(t["cam_T_grip"])[:3, 3]) for line, t in measured]
    )
    across_m, along_m = np.hypot(errors_m[:, 0], errors_m[:, 1]), np.abs(errors_m[:, 2])
    assert across_m.mean() < 15e-6 and across_m.max() < 50e-6
    assert along_m.mean() < 45e-6 and along_m.max() < 150e-6


def test_the_same_input_gives_the_same_bytes_and_standard_output_holds_lines_only(sequence: Path, tmp_path: Path):
    """In this process and in another one, with another hash seed."""
    arguments = ["replay", str(sequence), "--config", str(sequence / "config.yaml"), "--out", "-"]
    there = os.environ | {"PYTHONHASHSEED": "77"}
    done = subprocess.run([*GRIPMON, *arguments], capture_output=True, check=True, cwd=ROOT, env=there)
    replayed(sequence, tmp_path / "file.jsonl")
    (tmp_path / "stdout.jsonl").write_bytes(done.stdout)
    assert without_latency(tmp_path / "stdout.jsonl") == without_latency(tmp_path / "file.jsonl")
    [summary] = done.stderr.decode().splitlines()
    assert summary.startswith("replay: 20 frames: ")


def test_bad_frames_are_refused_with_a_reason_and_the_others_go_on(copied: Path, tmp_path: Path):
    good = cv2.imread(str(copied / "000005.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(copied / "000005.png"), np.zeros_like(good))
    cv2.imwrite(str(copied / "000007.png"), np.full_like(good, 255))
    cv2.imwrite(str(copied / "000009.png"), good[:100, :100])
    (copied / "000011.png").write_bytes((copied / "000012.png").read_bytes()[:5000])
    (copied / "000013.png").write_text("this is no image")
    (copied / "000015.png").write_bytes(b"")
    (copied / "000017.png").unlink()
    lines = replayed(copied, tmp_path / "out.jsonl")
    assert len(lines) == 20
    expected = {
        5: Refusal.BLACK, 7: Refusal.WHITE, 9: Refusal.WRONG_SIZE, 11: Refusal.NOT_AN_IMAGE, 13: Refusal.NOT_AN_IMAGE,
        15: Refusal.NOT_AN_IMAGE, 17: Refusal.NOT_AN_IMAGE,
    }  # fmt: skip
    for seq, refusal in expected.items():
        assert lines[seq]["reason"].startswith(refusal), lines[seq]["reason"]
        assert lines[seq]["verdict"] == "unknown" or lines[seq]["source"] == "held"
        assert not any(corner["used"] for corner in lines[seq]["corners"])
    assert all(lines[seq]["source"] == "update" for seq in (3, 4, 10, 18, 19))


def test_no_usable_frame_ends_with_3(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for path in copied.glob("*.png"):
        path.write_bytes(b"nothing")
    lines = replayed(copied, tmp_path / "out.jsonl", code=3)
    assert len(lines) == 20 and {line["verdict"] for line in lines} == {"unknown"}
    assert "no frame could be used (not_an_image: " in capsys.readouterr().err


def test_images_without_times_follow_each_other_at_the_rate_of_the_configuration(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Stills are no video: they count as 25 a second only if nobody says else, and that is said."""
    (copied / "timestamps.csv").unlink()
    for path in sorted(copied.glob("*.png"))[3:]:
        path.unlink()
    config = copied / "config.yaml"
    plain = config.read_text().replace("source: frames", "source: fixed")
    config.write_text(re.sub(r"  fps: [\d.]+", "", plain))
    stamps_ns = [line["stamp_ns"] for line in replayed(copied, tmp_path / "usual.jsonl")]
    assert stamps_ns == [0, 40_000_000, 80_000_000]
    said = "has no timestamps.csv: its images count as 25 a second; --fps HZ says else"
    assert capsys.readouterr().err.count(said) == 1
    config.write_text(re.sub(r"fps: [\d.]+", "fps: 0.5", plain))
    stamps_ns = [line["stamp_ns"] for line in replayed(copied, tmp_path / "slow.jsonl")]
    assert stamps_ns == [0, 2_000_000_000, 4_000_000_000] and "25 a second" not in capsys.readouterr().err
    stamps_ns = [line["stamp_ns"] for line in replayed(copied, tmp_path / "given.jsonl", "--fps", "4")]
    assert stamps_ns == [0, 250_000_000, 500_000_000] and "25 a second" not in capsys.readouterr().err


def test_a_video_gives_what_its_frames_give(sequence: Path, tmp_path: Path):
    """Lossless, so every number is that of the images, to rounding (the jaw opening is the nominal one in both)."""
    video = tmp_path / "wrist.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"FFV1"), FPS, (768, 576), isColor=False)
    if not writer.isOpened():
        pytest.skip("this OpenCV has no FFV1")
    for path in sorted(sequence.glob("*.png")):
        writer.write(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    writer.release()
    config = tmp_path / "config.yaml"
    text = (sequence / "config.yaml").read_text().replace("source: frames", "source: fixed")
    config.write_text(text.replace("gripper.yaml", str(sequence / "gripper.yaml")))
    from_video = replayed(video, tmp_path / "video.jsonl", config=config)
    from_images = replayed(sequence, tmp_path / "images.jsonl", config=config)
    assert len(from_video) == len(from_images) == 20
    for a, b in zip(from_video, from_images, strict=True):
        assert a["verdict"] == b["verdict"]
        # A video comes as BGR; turning it grey again rounds otherwise in the last digits.
        difference_m = np.subtract(a["cam_T_grip"]["translation_m"], b["cam_T_grip"]["translation_m"])
        np.testing.assert_allclose(difference_m, 0.0, atol=1e-9)


def test_an_output_that_cannot_be_written_is_said_before_work_begins(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = ["replay", str(sequence), "--config", str(sequence / "config.yaml"), "--out", str(tmp_path)]
    assert main(arguments) == 2
    assert capsys.readouterr().err.splitlines() == [f"--out {tmp_path}: is a folder; a file"]


def test_a_recording_that_cannot_be_written_is_said_before_work_begins(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config, out = str(sequence / "config.yaml"), tmp_path / "out.jsonl"
    assert main(["replay", str(sequence), "--config", config, "--out", str(out), "--recording", str(tmp_path)]) == 2
    assert not out.exists()
    assert capsys.readouterr().err.splitlines() == [f"--recording {tmp_path}: is a folder; a file"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
@pytest.mark.parametrize("out", ["/dev/full", "-"])
def test_a_disk_that_is_full_ends_with_3_and_one_line(sequence: Path, out: str):
    arguments = [*GRIPMON, "replay", str(sequence), "--config", str(sequence / "config.yaml"), "--out", out]
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert done.returncode == 3
    assert done.stderr.splitlines() == [f"--out {out}: writing failed (No space left on device)"]


def test_a_monitor_that_fails_on_a_frame_costs_that_frame_only(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    process = Monitor.process

    def failing(self: Monitor, frame: Frame, then: Beside | None) -> FrameRecord:
        if frame.seq in (4, 9):
            raise ValueError(f"singular {frame.seq}")
        return process(self, frame, then)

    monkeypatch.setattr(Monitor, "process", failing)
    lines = replayed(sequence, tmp_path / "out.jsonl")
    assert len(lines) == 20
    assert lines[9]["reason"] == "internal error: ValueError: singular 9" and lines[9]["cam_T_grip"] is None
    assert lines[10]["cam_T_grip"] is not None
    assert "2 failed (internal error: ValueError: singular 4)" in capsys.readouterr().err


def test_the_summary_needs_no_memory_for_each_frame():
    counts = Counts()
    latencies_ns = np.random.default_rng(3).lognormal(14.0, 0.5, 5001).astype(int).tolist()
    for seq, latency_ns in enumerate(latencies_ns):
        counts.add(frame_record(seq, latency_ns=latency_ns, source=Origin.HELD, reason=f"few_points: {seq} left"))
        counts.add(frame_record(seq, latency_ns=latency_ns, reason=f"the TCP may be {seq} mm off"))
    said = re.search(r"median ([0-9.]+) ms", counts.summary())
    assert said and float(said[1]) == pytest.approx(1e-6 * float(np.median(latencies_ns)), rel=0.015)
    assert len(counts._reasons) == 1 and len(counts._latencies) < 300


def test_a_replay_that_measured_too_little_says_so_first():
    counts, enough = Counts(), Counts()
    for seq in range(20):
        counts.add(frame_record(seq, source=Origin.HELD, reason="few") if seq < 3 else frame_record(seq))
        enough.add(frame_record(seq, source=Origin.HELD, reason="few") if seq < 2 else frame_record(seq))
    assert counts.caution()[0].startswith("only 17 of 20 frames were measured (3 in which the gripper was not found)")
    assert enough.caution() == []


def test_ctrl_c_leaves_whole_lines_and_130(sequence: Path, tmp_path: Path):
    many = tmp_path / "many"
    many.mkdir()
    for i in range(4000):
        (many / f"{i:06d}.png").symlink_to(sequence / f"{i % 20:06d}.png")
    out = tmp_path / "out.jsonl"
    config = tmp_path / "config.yaml"
    text = (sequence / "config.yaml").read_text().replace("source: frames", "source: fixed")
    config.write_text(text.replace("gripper.yaml", str(sequence / "gripper.yaml")))
    arguments = [*GRIPMON, "replay", str(many), "--config", str(config), "--out", str(out)]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        deadline_s = time.monotonic() + 60.0
        while not (out.exists() and out.stat().st_size > 0):
            assert process.poll() is None and time.monotonic() < deadline_s
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in err and "gripmon: interrupted" in err
    lines = [json.loads(line) for line in out.read_bytes().splitlines()]
    assert 0 < len(lines) < 4000 and [line["seq"] for line in lines] == list(range(len(lines)))
