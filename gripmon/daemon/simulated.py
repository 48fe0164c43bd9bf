"""Simulation: images with ground truth, and the whole daemon on a simulated wrist camera."""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
import shlex
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from gripmon.analyse.comparison import Comparison, compare
from gripmon.daemon.config import Config, builtin_config, load_config, load_scenario
from gripmon.daemon.config.settings import JawSettings
from gripmon.daemon.config.writing import reference_section, text_of
from gripmon.daemon.watch import is_refused
from gripmon.io.sources import FolderSettings, SimulatedSettings, SourceError, make_simulator
from gripmon.model.atomic import writable_folder
from gripmon.model.coverage import too_few
from gripmon.model.errors import InputError, input_errors
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, FrameRecord
from gripmon.model.stopping import StopRequest
from gripmon.model.targets import name_of
from gripmon.record.viewer import free_port
from gripmon.simulate import (
    CALIBRATION_KINDS,
    SCENARIO_NAMES,
    Scenario,
    Simulator,
    image_count,
    make_scenario,
    write_calibration_images,
    write_sequence,
)
from gripmon.simulate.calibration_images import BOARD, PLATE, SECOND_PLATE

if TYPE_CHECKING:
    from gripmon.client import Reading, TransformClient
    from gripmon.daemon.pace import Pace

_ZENOH_PORT = 7447
_CONNECT_S = 5.0
_TRACKING = ("tracking", "drifting")


class SimulatedImages(NamedTuple):
    """The folder, a matching configuration (None if calibrations come first), and the number of images."""

    folder: Path
    config: Path | None
    frames: int


def simulate_images(
    scenario: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    fps: float | None = None,
    step: Callable[[int, int], None] = lambda _done, _total: None,
) -> SimulatedImages:
    """Write one PNG per frame, ``timestamps.csv``, ``truth.jsonl`` (:class:`gripmon.simulate.FrameTruth`) and
    ``config.yaml`` with ``gripper.yaml`` to a new or empty folder.

    ``scenario``: a built-in name (:data:`gripmon.simulate.SCENARIO_NAMES`), which ``duration_s`` (s) and ``fps`` (1/s)
    adapt, or a YAML file; or the input of a calibration (:data:`gripmon.simulate.CALIBRATION_KINDS`): single images
    with ``truth.json``.  For "work" and these there is no configuration, which results from the calibrations.
    ``config``: camera, gripper and calibration; None: those of the demo.  ``step`` is called after each image with the
    number of images done and in total.  The same seed gives the same images.

    Raises :class:`InputError` for an unknown scenario, one that doesn't fit the configuration, or a folder that isn't
    empty.
    """
    out = Path(out)
    config = load_config(builtin_config("demo.yaml"), check_source=False) if config is None else config
    if scenario in CALIBRATION_KINDS:
        if (duration_s, fps) != (None, None):
            raise InputError(f"simulate: {scenario} is single images; neither --seconds nor --fps")
        return _calibration_images(str(scenario), out, config, seed, step)
    made = _scenario(scenario, config, duration_s, fps)
    with input_errors(str(scenario)):
        simulator = config.scene.simulator(made, seed)
    with _made(out):
        if scenario == "work":
            return SimulatedImages(out, None, write_sequence(simulator, out, step))
        config_path = out / "config.yaml"
        shutil.copyfile(config.gripper_path, out / "gripper.yaml")
        config_path.write_text(_config_text(config, made, seed), encoding="utf-8")
        return SimulatedImages(out, config_path, write_sequence(simulator, out, step))


def _scenario(name: str | Path, config: Config, duration_s: float | None, fps: float | None) -> Scenario:
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        if duration_s is not None or fps is not None:
            raise InputError(f"{name}: --seconds and --fps are for built-in scenarios; duration_s and fps in the file")
        return load_scenario(path)
    if name not in SCENARIO_NAMES:
        raise InputError(f"simulate: there is no '{name}'; one of {', '.join((*SCENARIO_NAMES, *CALIBRATION_KINDS))}")
    finger, opening_m = config.gripper.finger_ids[0], config.scene.jaw_opening_m
    with input_errors("simulate"):
        return make_scenario(str(name), duration_s=duration_s, fps=fps, finger=finger, jaw_opening_m=opening_m)


def _calibration_images(
    kind: str, out: Path, config: Config, seed: int, step: Callable[[int, int], None]
) -> SimulatedImages:
    count, done = image_count(kind), itertools.count(1)
    with _made(out), input_errors(f"simulate {kind}"):
        write_calibration_images(kind, config.scene, out, seed, lambda: step(next(done), count))
    return SimulatedImages(out, None, count)


@contextmanager
def _made(path: Path) -> Iterator[None]:
    """A new or empty folder, and what is written to it."""
    if any(writable_folder(path).iterdir()):
        raise InputError(f"{path}: is not empty; a new or empty folder", "out")
    try:
        yield
    except OSError as error:
        wrong = f"can't be written ({error.strerror or error}); what is there isn't whole"
        raise InputError(f"{path}: {wrong}", "out") from None


def next_step(kind: str, made: SimulatedImages, gripper: Gripper) -> str:
    """The command that uses these images of ``gripper``."""
    out = str(made.folder)
    if made.config is not None:
        return shlex.join(["gripmon", "replay", out, "--config", str(made.config), "--out", f"{out}.jsonl"])
    folder = shlex.quote(out)
    jaw = f"--jaw-range {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g} " if gripper.has_jaw else ""
    return {
        "plate": f"gripmon calibrate intrinsics {folder} --target {name_of(PLATE)} --model paper --out camera.yaml",
        "standing": f"gripmon calibrate plane {folder} --target camera.yaml --camera camera.yaml --corners "
        f"{folder}/rough.yaml --infer {jaw}--gripper-out gripper.yaml --out hand_eye.yaml",
        "work": f"gripmon teach {folder}/000000.png --corners standing/rough.yaml --camera camera.yaml "
        "--gripper gripper.yaml --reference hand_eye.yaml --robot arm1 --out mine",
        "robot_world": f"gripmon calibrate robot-world {folder}/views.csv --camera camera.yaml --target "
        f"{name_of(BOARD)} --eye-in-hand --out robot_world.yaml",
        "spots": f"gripmon calibrate intrinsics {folder}/plate --target {name_of(SECOND_PLATE)} --out second.yaml, "
        f"then gripmon calibrate laser {folder}/spots.csv --camera second.yaml --out laser.yaml",
    }[kind]


def _config_text(config: Config, scenario: Scenario, seed: int) -> str:
    """A commented configuration for the sequence, like the hand-written ones."""
    reported, known = config.gripper.has_jaw and scenario.jaw.reported, config.settings.reference
    sigmas = {"position_sigma_m": known.position_sigma_m, "rotation_sigma_rad": known.rotation_sigma_rad}
    return text_of(
        f"gripmon simulate {scenario.name} --seed {seed}", robot="simulated", camera_name="wrist",
        camera=config.settings.camera, gripper="gripper.yaml",
        reference=reference_section(config.reference.cam_T_grip, **sigmas), source=FolderSettings(path="."),
        jaw=JawSettings(source="frames" if reported else "fixed"),
    )  # fmt: skip


class Latency(msgspec.Struct, frozen=True):
    """Latency from a frame to its published transform (ms); None without frames."""

    median: float | None
    p99: float | None


class DemoSummary(msgspec.Struct, frozen=True):
    """The result of the demo, as in ``summary.json``.

    ``caution``: what to read first, empty if nearly all frames were measured but for those that the hand covers;
    ``camera_fps``: of the simulated camera (1/s); ``live``: false if it waited for the monitor.
    """

    caution: str
    camera_fps: float
    live: bool
    frames: int
    frames_dropped: int
    frames_per_s: float | None
    transforms_received: int
    latency_ms: Latency
    latency_while_tracking_ms: Latency
    recordings: tuple[str, ...]
    comparison: Comparison


def at_own_pace(config: Config) -> tuple[Config, Pace]:
    """The demo's configuration with the frame rate that this machine can keep, which is measured; where it can keep
    none, every frame waits for the one before.

    Raises :class:`InputError` if nothing can be rendered.
    """
    from gripmon.daemon.pace import measure_pace

    source = config.settings.source
    assert isinstance(source, SimulatedSettings), "the shipped demo.yaml has a simulated camera"
    try:
        simulator = make_simulator(source, config.scene, config.directory)
        pace = measure_pace(config, simulator, source.processes)
    except SourceError as error:
        raise InputError(f"demo: {error}") from None
    source = msgspec.structs.replace(source, fps=pace.fps, realtime=pace.live)
    settings = msgspec.structs.replace(config.settings, source=source)
    return dataclasses.replace(config, settings=settings), pace


def demo_config(duration_s: float, *, fps: float | None = None, seed: int = 1, viewed: bool = False) -> Config:
    """The shipped configuration with the given duration and free ports.

    Raises :class:`InputError` for values that no scenario can have.
    """
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    settings = config.settings
    changes = {"duration_s": duration_s, "ends": True, "seed": seed} | ({} if fps is None else {"fps": fps})
    try:
        source = msgspec.convert(msgspec.to_builtins(settings.source) | changes, SimulatedSettings)
    except msgspec.ValidationError as error:
        raise InputError(f"demo: {error}") from None
    publish = msgspec.structs.replace(settings.publish, listen=(f"tcp/127.0.0.1:{free_port(_ZENOH_PORT)}",))
    view = settings.view
    if viewed:
        view = msgspec.structs.replace(view, port=free_port(view.port), web_port=free_port(view.web_port))
    settings = msgspec.structs.replace(settings, source=source, publish=publish, view=view)
    return dataclasses.replace(config, settings=settings)


class Demo:
    """One run of the demo: a simulated camera, the daemon, and a client that counts the messages it receives."""

    def __init__(self, config: Config) -> None:
        """``config``: from :func:`demo_config`.  Raises :class:`InputError` if its scenario is impossible."""
        assert isinstance(config.settings.source, SimulatedSettings), "the shipped demo.yaml has a simulated camera"
        self._config = config
        try:
            self._simulator: Simulator = make_simulator(config.settings.source, config.scene, config.directory)
        except SourceError as error:
            raise InputError(f"demo: {error}") from None

    @property
    def frame_count(self) -> int:
        """Number of frames of the scenario."""
        return self._simulator.frame_count

    def run(
        self,
        out: Path,
        *,
        step: Callable[[], None],
        on_network: Callable[[], object],
        view: str | None = None,
        stop: StopRequest | None = None,
    ) -> tuple[int, DemoSummary | None]:
        """The daemon's exit code, and the summary, which is also written to ``out``; None without estimates of a frame.

        ``step`` is called for each transform that arrives, ``on_network`` when the client has joined; ``stop``: see
        :class:`gripmon.daemon.starting.RunOptions`.
        """
        from gripmon.daemon.service import log_to_stderr
        from gripmon.daemon.starting import RunOptions, run_monitor

        source = self._config.settings.source
        assert isinstance(source, SimulatedSettings), "checked before"

        def truth_tcp_m(seq: int) -> tuple[float, float, float]:
            x, y, z = self._simulator.truth(seq).cam_T_grip[:3, 3].tolist()
            return x, y, z

        with _Receiver(self._config, step) as receiver:

            def joined() -> None:
                receiver.connect()
                on_network()

            log_to_stderr()
            options = RunOptions(
                out=out, stop=stop, keep_state=False, view=view, on_network=joined, recording_name="demo",
                truth_tcp_m=truth_tcp_m,
            )  # fmt: skip
            code = run_monitor(self._config, options)
        return code, _summarise(out, self._simulator, receiver.count, live=source.realtime)


class _Receiver(AbstractContextManager["_Receiver"]):
    """A second Zenoh session that counts the transforms that arrive, calling ``step`` for each."""

    def __init__(self, config: Config, step: Callable[[], None]):
        self.count = 0
        self._last_seq = -1
        self._config = config
        self._step = step
        self._client: TransformClient | None = None

    def connect(self) -> None:
        """Join the network and wait until the monitor appears."""
        from gripmon.client import TransformClient

        settings = self._config.settings
        where = settings.publish.listen
        self._client = TransformClient(settings.robot, settings.camera_name, connect=where, depth=1024)
        self._client.on_transform(self._arrived)
        deadline_s = time.monotonic() + _CONNECT_S
        while not self._client.alive(timeout_s=0.2) and time.monotonic() < deadline_s:
            time.sleep(0.02)

    def __exit__(self, *_exception: object) -> None:
        if self._client is not None:
            self._client.close()

    def _arrived(self, reading: Reading) -> None:
        if reading.seq != self._last_seq:  # not one that says that nothing came
            self._last_seq = reading.seq
            self.count += 1
            self._step()


def _summarise(out: Path, simulator: Simulator, received: int, *, live: bool) -> DemoSummary | None:
    """Compare ``estimates.jsonl`` with the truth, and write ``summary.json``."""
    estimates = out / "estimates.jsonl"
    decode = msgspec.json.Decoder(FrameRecord).decode
    lines = estimates.read_bytes().splitlines(keepends=True) if estimates.exists() else []
    records = [decode(line) for line in lines if line.endswith(b"\n")]  # the last one of a full disk is cut
    if not records:
        return None
    latencies_ms = 1e-6 * np.array([record.latency_ns for record in records])
    span_s = 1e-9 * (records[-1].stamp_ns - records[0].stamp_ns)
    dropped = records[-1].seq + 1 - len(records)
    shown = [
        r for r in records if r.measured or "hand" not in simulator.truth(r.seq).events
    ]  # what is covered can't be
    measured, refused = sum(r.measured for r in shown), sum(is_refused(r) for r in shown)
    summary = DemoSummary(
        caution=too_few(measured, dropped=dropped, refused=refused, unseen=len(shown) - measured - refused),
        camera_fps=simulator.scenario.fps,
        live=live,
        frames=len(records),
        frames_dropped=dropped,
        frames_per_s=(len(records) - 1) / span_s if span_s > 0.0 else None,
        transforms_received=received,
        latency_ms=_latency(latencies_ms),
        latency_while_tracking_ms=_latency(latencies_ms[[r.state in _TRACKING for r in records]]),
        recordings=tuple(sorted(path.name for path in out.glob("*.rrd"))),
        comparison=compare(records, simulator.truth),
    )
    text = json.dumps(msgspec.to_builtins(summary), indent=2) + "\n"
    try:
        (out / "summary.json").write_text(text, encoding="utf-8")
    except OSError as error:
        logging.getLogger(__name__).error("%s can't be written: %s", out / "summary.json", error.strerror)
    return summary


def _latency(latencies_ms: Array) -> Latency:
    if not latencies_ms.size:
        return Latency(None, None)
    return Latency(float(np.median(latencies_ms)), float(np.percentile(latencies_ms, 99.0)))
