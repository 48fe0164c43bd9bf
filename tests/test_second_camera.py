"""The daemon on a second camera: rendered spots in, alerts out, as users run it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.loopback import WAIT_S, free_endpoint, wait_until
from support.network_daemon import ENVIRONMENT
from support.pulse_feeder import MARGIN_S, NOT_PULSES
from support.pulsed_scenes import MOVED, PREFIX, cell, write_config, write_folder

from gripmon.cli import main
from gripmon.client import Fleet
from gripmon.model.geometry import invert, perturb
from gripmon.model.records import AlertEvent, AlertKind, AlertRecord, SpotRecord, State, from_json

HERE = Path(__file__).resolve().parent
PULSES, MOVED_FROM = 14, 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pulses of a camera that was knocked between two of them."""
    out = tmp_path_factory.mktemp("moved")
    write_folder(cell(), out, PULSES, MOVED_FROM)
    return out


def spots(out: Path) -> list[SpotRecord]:
    return [from_json(line, SpotRecord) for line in (out / "spots.jsonl").read_bytes().splitlines()]


def entities(recording: Path) -> set[str]:
    return {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}


def said_in(recording: Path, entity: str) -> list[dict[str, object]]:
    """The JSON texts of an entity, in order."""
    texts: list[dict[str, object]] = []
    for chunk in RrdReader(recording).stream():
        if str(chunk.entity_path) == entity:
            batch = chunk.to_record_batch()
            (name,) = [n for n in batch.schema.names if n.endswith("json")]
            texts += [json.loads(cell[0]) for cell in batch.column(name).to_pylist() if cell]
    return texts


@pytest.fixture(scope="module")
def recorded(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``gripmon run`` on that folder leaves."""
    out = tmp_path_factory.mktemp("recorded")
    config = write_config(cell(), folder, None, recording={"image_format": "png"})
    assert main(["run", str(config), "--out", str(out)]) == 0
    return out


def test_a_folder_with_its_pulses_runs_to_the_end(recorded: Path):
    found = spots(recorded)
    assert [spot.pulse for spot in found] == list(range(PULSES))
    assert all(spot.frames == 2 and spot.background and spot.candidates >= 1 for spot in found)
    before = found[:MOVED_FROM]
    assert all(spot.used and not spot.alerts for spot in before) and before[-1].state is State.TRACKING
    for k, spot in enumerate(found):
        moved = MOVED if k >= MOVED_FROM else None
        assert spot.uv_px is not None and np.abs(np.array(spot.uv_px) - cell().uv_px(k, moved)).max() < 0.7
    raised = [alert for spot in found[MOVED_FROM:] for alert in spot.alerts if alert.event is AlertEvent.RAISED]
    assert any(alert.kind in (AlertKind.DRIFT, AlertKind.STEP) for alert in raised)
    assert found[-1].probability_moved > 0.99 and found[-1].state is State.DRIFTING
    (recording,) = recorded.glob("*.rrd")
    assert entities(recording) >= {
        "/base/camera/image", "/base/camera/image/spot/believed", "/base/camera/image/foreseen", "/base/beam",
        "/base/plane", "/off/px", "/off/sigma_px", "/gaps/mm", "/test/moved", "/record", "/meta", "/configuration",
        "/events", "/status/state", "/state",
    }  # fmt: skip
    assert [each["pulse"] for each in said_in(recording, "/record")] == list(range(PULSES))
    (configuration,) = said_in(recording, "/configuration")
    assert {"second.yaml", "laser.yaml"} == set(configuration["files"])  # type: ignore[call-overload]


@pytest.mark.parametrize("command", ["report", "export", "correct", "replay"])
def test_who_reads_frames_says_that_there_are_none(
    recorded: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
):
    (recording,) = recorded.glob("*.rrd")
    assert main([command, str(recording), "--out", str(tmp_path / "out.jsonl")]) == 3
    said = capsys.readouterr().err
    assert f"{recording}: holds a second camera's laser spots, no frames; gripmon view shows them" in said


def test_a_camera_that_stands_still_gives_no_alert(tmp_path: Path):
    write_folder(cell(), tmp_path, 10)
    config = write_config(cell(), tmp_path, None)
    assert main(["run", str(config), "--out", str(tmp_path / "out")]) == 0
    found = spots(tmp_path / "out")
    assert len(found) == 10 and all(spot.used and not spot.alerts for spot in found)
    assert found[-1].verdict == "valid"


def test_replay_decides_the_same_each_time(recorded: Path, folder: Path, tmp_path: Path):
    """The same core: what the daemon decided, but for the time that it took."""
    config = write_config(cell(), folder, None)
    outs = [tmp_path / f"{k}.jsonl" for k in range(2)]
    for out in outs:
        assert main(["replay", str(folder / "images"), "--config", str(config), "--out", str(out)]) == 0
    first, second = (out.read_bytes() for out in outs)
    assert first == second
    again = [from_json(line, SpotRecord) for line in first.splitlines()]
    assert again == [msgspec.structs.replace(spot, latency_ns=0) for spot in spots(recorded)]


def test_pulses_without_a_spot_are_a_failure(tmp_path: Path):
    """A laser that was never on: the frames are there, and nothing was watched."""
    write_folder(cell(), tmp_path, 2)
    lines = (tmp_path / "images" / "timestamps.csv").read_text().splitlines()
    for k, line in enumerate(lines[1:]):
        if k % 3:  # with the laser on
            (tmp_path / "images" / line.partition(",")[0]).write_bytes((tmp_path / "images" / "0000.png").read_bytes())
    assert main(["run", str(write_config(cell(), tmp_path, None)), "--out", str(tmp_path / "out")]) == 3
    assert [str(spot.fault) for spot in spots(tmp_path / "out")] == ["no_spot", "no_spot"]


# --- as a process, with a driver and a robot in another


class Daemon:
    """``gripmon run`` with frames and pulses from the network, and what a fleet hears of it."""

    def __init__(self, folder: Path, out: Path) -> None:
        self.endpoint, self.out = free_endpoint(), out
        config = write_config(
            cell(), folder, self.endpoint, source={"kind": "zenoh"}, recording={"enabled": True},
            laser={"calibration": str(cell().folder / "laser.yaml"), "frames": {"margin_s": MARGIN_S}},
        )  # fmt: skip
        self.log = out / "stderr.txt"
        self.feeder: subprocess.Popen[bytes] | None = None
        command = [sys.executable, "-m", "gripmon", "run", str(config), "--out", str(out)]
        with self.log.open("wb") as stderr:
            self.process = subprocess.Popen(command, stderr=stderr, env=ENVIRONMENT)
        wait_until(lambda: "watching cell/second" in self.log.read_text() or self.process.poll() is not None, "a start")
        assert self.process.poll() is None, self.log.read_text()
        self.alerts: list[AlertRecord] = []
        self.fleet = Fleet(connect=self.endpoint, on_alert=lambda _name, record, _payload: self.alerts.append(record))

    def feed(self, folder: Path, rubbish: int = 0) -> list[SpotRecord]:
        """What became of all pulses; frames go on until the end."""
        command = [
            sys.executable,
            str(HERE / "support" / "pulse_feeder.py"),
            self.endpoint,
            PREFIX,
            str(folder),
            str(rubbish),
        ]
        self.feeder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT)
        assert self.feeder.stdout is not None
        lines = [line for _, line in zip(range(PULSES), self.feeder.stdout, strict=False)]
        assert len(lines) == PULSES, self.log.read_text()
        return [from_json(line, SpotRecord) for line in lines]

    def send(self, *words: str) -> int:
        return main(["send", *words, "--robot", "cell", "--camera", "second", "--connect", self.endpoint])

    def close(self) -> None:
        self.fleet.close()
        for process in (self.process, self.feeder):
            if process is not None:
                process.kill()
                process.communicate()


@pytest.fixture(scope="module")
def daemon(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    running = Daemon(folder, tmp_path_factory.mktemp("out"))
    try:
        yield running
    finally:
        running.close()


def true_displacement_m() -> np.ndarray:
    """Of the place on the plane that the camera's axis meets, camera axes: from the truth alone."""
    setup = cell().data.truth
    point = np.array([0.0, 0.0, setup.distance_m / setup.normal_cam[2], 1.0])
    still, moved = invert(setup.cam_T_base), invert(perturb(setup.cam_T_base, MOVED))
    out: np.ndarray = still[:3, :3].T @ ((moved - still) @ point)[:3]
    return out


def test_a_knock_is_heard_by_whoever_listens(daemon: Daemon, folder: Path, capfd: pytest.CaptureFixture[str]):
    """From rendered frames and pulses in another process to alerts in this one, rubbish between the pulses."""
    found = daemon.feed(folder, rubbish=len(NOT_PULSES))
    assert [spot.state for spot in found[2:MOVED_FROM]] == [State.TRACKING] * (MOVED_FROM - 2)
    # A feeder that begins late is an alert of the source, before any pulse.

    def of_pulses() -> list[AlertRecord]:
        return [alert for alert in daemon.alerts if alert.kind is not AlertKind.SOURCE]

    wait_until(of_pulses, "an alert")
    first = of_pulses()[0]
    assert first.kind in (AlertKind.DRIFT, AlertKind.STEP) and first.event is AlertEvent.RAISED
    assert (first.robot, first.camera, first.revision) == ("cell", "second", 0)
    assert first.reference_id.startswith("laser-") and first.stamp_ns >= found[MOVED_FROM].stamp_ns
    assert all(alert.stamp_ns > found[MOVED_FROM - 1].until_ns for alert in of_pulses())

    def state() -> object:
        (status,) = daemon.fleet.monitors()
        return status.state

    wait_until(lambda: getattr(state(), "malformed", 0) == len(NOT_PULSES), "all rubbish to be counted")
    (status,) = daemon.fleet.monitors()
    assert status.state is not None and status.state.sigma_m is not None and status.state.tcp_shift_m is not None
    off_m = np.abs(np.array(status.state.tcp_shift_m) - true_displacement_m()).max()
    assert off_m < 5.0 * status.state.sigma_m and status.state.sigma_m < 3e-3
    assert "malformed pulse message" in status.state.message
    assert first.alert_id in {alert.alert_id for alert in status.alerts}
    assert main(["watch", "--once", "--connect", daemon.endpoint]) == 0
    table = capfd.readouterr().out
    assert "cell/second" in table and "spots are" in table


def test_commands_that_make_no_sense_are_refused_in_words(
    daemon: Daemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name in ("recalibrate", "accept", "reject", "undo"):
        assert daemon.send(name) == 3
        assert "refused: this is a second camera" in capsys.readouterr().err
    assert daemon.send("state") == 0
    assert "laser-" in capsys.readouterr().out
    assert daemon.send("snapshot", "--out", str(tmp_path)) == 0
    assert (tmp_path / "snapshot-1.png").stat().st_size > 10_000
    assert daemon.send("acknowledge") == 0
    assert "acknowledged" in capsys.readouterr().out
    assert daemon.send("reset") == 0
    wait_until(lambda: daemon.alerts[-1].event is AlertEvent.CLEARED, "the alert to be cleared")


def test_sigterm_ends_it_in_order(daemon: Daemon):
    """Last of all: a recording that is whole, and a last word."""
    daemon.process.terminate()
    assert daemon.process.wait(WAIT_S) == 0
    wait_until(lambda: daemon.fleet.monitors()[0].condition == "stopped", "the fleet to see that it stopped")
    log = daemon.log.read_text()
    assert "Traceback" not in log and "stopped after" in log
    (recording,) = daemon.out.glob("*.rrd")
    events = Counter(str(chunk.entity_path) for chunk in RrdReader(recording).stream())
    assert events["/command"] and events["/base/camera/image"] and len(spots(daemon.out)) >= PULSES
