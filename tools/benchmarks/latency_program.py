"""The parts of ``tools/bench latency`` that run gripmon as it is used: commands, replay, start."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np
import yaml

from benchmarks import scene
from benchmarks.harness import free_endpoint
from benchmarks.machine import ROOT
from benchmarks.parts import Measured, Row
from gripmon.io.publish.feeding import FramePublisher

REPLAYED_PER_S, START_S, HELP_S, IMPORT_S, ABOVE_MB = 800.0, 1.5, 0.1, 0.2, 100.0
_START_WITHIN_S = 120.0  # the first start may compile
_LIBRARIES = "numba, cv2, scipy, zenoh"
_GRIPMON = (sys.executable, "-m", "gripmon")


@dataclass(frozen=True)
class Plan:
    """How long the daemon and the demo run; images that are replayed; starts and calls that are timed."""

    daemon_s: float = 60.0
    load_s: float = 30.0
    demo_s: float = 20.0
    replayed: int = 600
    starts: int = 5
    calls: int = 9


def demo(_: tuple[Path, ...], plan: Plan) -> Measured:
    """``gripmon demo`` as it is."""
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        command = [*_GRIPMON, "demo", "--seconds", f"{plan.demo_s:g}", "--out", scratch]
        subprocess.run(command, check=True, capture_output=True)
        summary = json.loads((Path(scratch) / "summary.json").read_text(encoding="utf-8"))
        with (Path(scratch) / "estimates.jsonl").open(encoding="utf-8") as lines:
            first = json.loads(next(lines))["seq"]
    times = (("frame to published transform", "latency_ms"), ("while tracking", "latency_while_tracking_ms"))
    notes = [
        f"{when}: median {ms['median']:.3g} ms, 99 % {ms['p99']:.3g} ms"
        for when, ms in ((when, summary[key]) for when, key in times)
        if ms["median"] is not None
    ]
    title, note = f"gripmon demo --seconds {plan.demo_s:g}: frames dropped", f"{first} of them before the first one"
    row = Row(title, summary["frames_dropped"], "frames", 0, note=note)
    return Measured((row,), (f"{summary['frames']} frames; " + "; ".join(notes),))


def replay(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """``gripmon replay`` of a folder of PNGs, as the command does it, less the reading and decoding of files."""
    quiet, creeping = (_replayed(path, plan.replayed) for path in paths)
    title = f"replay of {plan.replayed} images, decoding aside"
    return Measured(
        (
            Row(title, quiet.per_s, "frames/s", REPLAYED_PER_S, True, quiet.note),
            Row("the same while the mount creeps, whose causes are analysed", creeping.per_s, "frames/s",
                note=creeping.note),
        ),
        ("without the first frame, which loads machine code",),
    )  # fmt: skip


class _Replayed(NamedTuple):
    """Frames a second; and what they are with decoding."""

    per_s: float
    note: str


def _replayed(path: Path, count: int) -> _Replayed:
    from gripmon.daemon.replaying import open_replay
    from gripmon.model.records import to_json

    ends_s: list[float] = []
    used_s: list[float] = []
    reading_s: list[float] = []
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-", dir=path.parent) as scratch, contextlib.ExitStack() as on:
        folder, ring = Path(scratch) / "images", scene.Ring.load(path)
        write_folder(ring, folder, count)
        on.enter_context(_timed_decoding(reading_s))
        config = write_config(Path(scratch), ring.size)
        replayed = on.enter_context(open_replay([folder], config, None, lambda text: None))
        out = on.enter_context((Path(scratch) / "out.jsonl").open("wb"))
        for record in replayed.records(lambda: None):
            out.write(to_json(record) + b"\n")
            if not record.measured:
                raise RuntimeError(f"{folder}: frame {record.seq} was not measured: {record.reason}")
            ends_s.append(time.perf_counter())
            used_s.append(time.process_time())
    frames, whole_s = len(ends_s) - 1, ends_s[-1] - ends_s[0]
    decoding_s = sum(reading_s[1:])
    note = (
        f"{frames / whole_s:.0f} with decoding, {1e3 * decoding_s / frames:.3g} ms a frame; "
        f"processor time of both {1e3 * (used_s[-1] - used_s[0]) / frames:.3g} ms"
    )
    return _Replayed(frames / (whole_s - decoding_s), note)


def write_folder(ring: scene.Ring, folder: Path, count: int) -> None:
    """This many frames of a ring as PNG with their time stamps; the same image is one file on disk."""
    folder.mkdir()
    table, files = ["file,stamp_ns,jaw_opening_m"], {}
    for seq in range(count):
        frame, place, path = ring.frame(seq), ring.place(seq), folder / f"{seq:06d}.png"
        if place in files:
            os.link(files[place], path)
        else:
            cv2.imwrite(str(path), ring.images[place])
            files[place] = path
        table.append(f"{path.name},{frame.stamp_ns},{frame.jaw_opening_m!r}")
    (folder / "timestamps.csv").write_text("\n".join(table) + "\n", encoding="utf-8")


@contextlib.contextmanager
def _timed_decoding(times_s: list[float]) -> Iterator[None]:
    """Notes how long each image takes to read, by a stop watch about the function that the source of a folder calls."""
    from gripmon.io.sources import files

    original = files.read_image

    def timed(path: Path) -> Any:
        start_s = time.perf_counter()
        try:
            return original(path)
        finally:
            times_s.append(time.perf_counter() - start_s)

    files.read_image = timed
    try:
        yield
    finally:
        files.read_image = original


def start(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """``gripmon run`` on a camera on the network that is there already, until its first transform has arrived."""
    took_s, used_s = [], []
    with _Camera(paths[0]) as camera:
        for _ in range(plan.starts + 1):
            start_s = time.monotonic()
            with _running(camera) as process:
                took_s.append(camera.first_s - start_s)
                used_s.append(_processor_s(process.pid))
    first_s, later_s = took_s[0], took_s[1:]
    note = f"first start {first_s:.3g} s; later ones {min(later_s):.3g} to {max(later_s):.3g} s"
    row = Row("gripmon run until its first transform, machine code cached", statistics.median(later_s), "s", START_S)
    used = Row("the same, processor time of its process", statistics.median(used_s[1:]), "s")
    return Measured((dataclasses.replace(row, note=note), used))


def memory(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """What the libraries take alone, and ``gripmon run`` with a camera on the network above it; its recording aside."""
    waiting = f"import {_LIBRARIES}; print(flush=True); input()"
    command = [sys.executable, "-c", waiting]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as libraries:
        assert libraries.stdout is not None
        libraries.stdout.readline()
        alone = _resident_mb(libraries.pid)
        libraries.communicate("\n")
    with _Camera(paths[0]) as camera, _running(camera) as process:
        time.sleep(plan.daemon_s)
        whole = _resident_mb(process.pid)
    rows = [
        Row(f"gripmon run above import {_LIBRARIES}, {name}", whole[key] - alone[key], "MB", ABOVE_MB,
            note=f"{whole[key]:.0f} MB, the libraries alone {alone[key]:.0f} MB")
        for key, name in (("Rss", "resident"), ("Pss", "resident, shared pages by share"))
    ]  # fmt: skip
    return Measured(tuple(rows), (f"after {plan.daemon_s:g} s at {scene.FPS:g} frames/s",))


@contextlib.contextmanager
def _running(camera: _Camera) -> Iterator[subprocess.Popen[bytes]]:
    """``gripmon run`` of a camera, with recording, once its first transform has arrived."""
    camera.transform.clear()
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        network = {"mode": "peer", "listen": [], "connect": [camera.endpoint]}
        config = write_config(Path(scratch), camera.size, source={"kind": "zenoh"}, publish=network)
        command = [*_GRIPMON, "run", str(config), "--out", str(Path(scratch) / "out")]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            if not camera.transform.wait(_START_WITHIN_S):
                raise RuntimeError("no transform came")
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30.0)


def _resident_mb(pid: int) -> dict[str, float]:
    """``Rss``, and ``Pss`` with what several processes share counted by their number."""
    rows = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
    return {row.split(":")[0]: 1.024e-3 * float(row.split()[1]) for row in rows}


def _processor_s(pid: int) -> float:
    """Of all threads of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


class _Camera:
    """A camera's driver on the network at 60 frames/s; it also waits for the monitor's transforms."""

    def __init__(self, path: Path) -> None:
        self._ring, self.endpoint = scene.Ring.load(path), free_endpoint()
        self.size = self._ring.size
        self.transform, self.first_s = threading.Event(), 0.0
        self._ended = threading.Event()

    def __enter__(self) -> _Camera:
        import zenoh

        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", json.dumps([self.endpoint]))
        self._session = zenoh.open(config)
        self._subscriber = self._session.declare_subscriber("gripmon/demo/wrist/transform", self._arrived)
        self._thread = threading.Thread(target=self._drive, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]

    def _arrived(self, sample: Any) -> None:
        record = json.loads(sample.payload.to_bytes())
        if record["source"] != "held" and record["cam_T_grip"] is not None and not self.transform.is_set():
            self.first_s = time.monotonic()
            self.transform.set()

    def _drive(self) -> None:
        publisher, seq = FramePublisher(self._session, "gripmon/demo/wrist/image"), 0
        while not self._ended.wait(1.0 / scene.FPS):
            frame, seq = self._ring.frame(seq), seq + 1
            assert isinstance(frame.image, np.ndarray)
            publisher.put(frame.image, stamp_ns=time.time_ns(), jaw_opening_m=frame.jaw_opening_m)


def write_config(folder: Path, size: scene.Size, **changes: Any) -> Path:
    """The demo's configuration as a file, for frames of a size; ``changes`` replace sections."""
    demo = ROOT / "configs" / "demo.yaml"
    config = yaml.safe_load(demo.read_text(encoding="utf-8"))
    config["gripper"] = str(demo.parent / config["gripper"])
    config["camera"] = msgspec.to_builtins(scene.config_for(size).settings.camera)
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config | changes), encoding="utf-8")
    return path


def commands(_: tuple[Path, ...], plan: Plan) -> Measured:
    """What everybody waits for who types a command or imports the package; files are in the cache of the disk."""
    help_s = _median_s([*_GRIPMON, "--help"], plan.calls)
    bare_s = _median_s([sys.executable, "-c", "pass"], plan.calls)
    imported_s = _median_s([sys.executable, "-c", "import gripmon"], plan.calls) - bare_s
    return Measured(
        (
            Row("gripmon --help", help_s, "s", HELP_S),
            Row("import gripmon", imported_s, "s", IMPORT_S, note=f"above an interpreter alone, {bare_s:.3g} s"),
        )
    )


def _median_s(command: list[str], times: int) -> float:
    """Of several runs; the first, which fills caches, doesn't count."""
    took_s = []
    for _ in range(times + 1):
        start_s = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        took_s.append(time.perf_counter() - start_s)
    return statistics.median(took_s[1:])
