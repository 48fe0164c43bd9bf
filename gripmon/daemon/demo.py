"""The whole daemon on a simulated wrist camera, and what it made of it against the truth."""

from __future__ import annotations

import dataclasses
import json
import socket
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import msgspec
import numpy as np

from gripmon.analyse.comparison import Comparison, compare
from gripmon.client import Client
from gripmon.daemon.config import Config, builtin_config, load_config
from gripmon.daemon.starting import LiveView, run_monitor
from gripmon.io.sources import SimulatedSettings, SourceError, make_simulator
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.records import Array, FrameRecord
from gripmon.model.stopping import StopRequest
from gripmon.record.viewer import free_port
from gripmon.simulate import Simulator

_PREFERRED_PORT = 7447
_CONNECT_S = 5.0
_TRACKING = ("tracking", "drifting")


class Latency(msgspec.Struct, frozen=True):
    """From a frame to its published transform (ms); None without frames."""

    median: float | None
    p99: float | None


class DemoSummary(msgspec.Struct, frozen=True):
    """How the demo went: what ``summary.json`` holds."""

    frames: int
    frames_dropped: int
    frames_per_s: float | None
    transforms_received: int
    latency_ms: Latency
    latency_while_tracking_ms: Latency
    recordings: tuple[str, ...]
    comparison: Comparison


def demo_config(duration_s: float, *, fps: float | None = None, seed: int = 1, viewed: bool = False) -> Config:
    """The shipped configuration, with the length asked for and ports that are free.

    Raises :class:`InputError` for what no scenario can have, :class:`NoResultError` without a free port.
    """
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    settings = config.settings
    changes = {"duration_s": duration_s, "ends": True, "seed": seed} | ({} if fps is None else {"fps": fps})
    try:
        source = msgspec.convert(msgspec.to_builtins(settings.source) | changes, SimulatedSettings)
    except msgspec.ValidationError as error:
        raise InputError(f"demo: {error}") from None
    publish = msgspec.structs.replace(settings.publish, listen=(f"tcp/127.0.0.1:{_free_port()}",))
    view = settings.view
    if viewed:
        view = msgspec.structs.replace(view, port=free_port(view.port), web_port=free_port(view.web_port))
    settings = msgspec.structs.replace(settings, source=source, publish=publish, view=view)
    return dataclasses.replace(config, settings=settings)


class Demo:
    """One run: a simulated camera, the daemon, and a client on the network that counts what it receives."""

    def __init__(self, config: Config) -> None:
        """``config`` by :func:`demo_config`.  Raises :class:`InputError` if its scenario can't be."""
        assert isinstance(config.settings.source, SimulatedSettings), "the shipped demo.yaml has a simulated camera"
        self._config = config
        try:
            self._simulator: Simulator = make_simulator(config.settings.source, config.scene, config.directory)
        except SourceError as error:
            raise InputError(f"demo: {error}") from None

    @property
    def frame_count(self) -> int:
        """How many frames the scenario has."""
        return self._simulator.frame_count

    def run(
        self,
        out: Path,
        *,
        step: Callable[[], None],
        on_network: Callable[[], object],
        view: LiveView | None = None,
        stop: StopRequest | None = None,
    ) -> tuple[int, DemoSummary | None]:
        """The daemon's exit code, and the summary, which is also written to ``out``; None if no frame was processed.

        ``step`` is called for each transform that arrives, ``on_network`` when the client has joined; ``stop``: see
        :func:`gripmon.daemon.starting.run_monitor`.
        """

        def truth_tcp_m(seq: int) -> tuple[float, float, float]:
            x, y, z = self._simulator.truth(seq).cam_T_grip[:3, 3].tolist()
            return x, y, z

        with _Receiver(self._config, step) as receiver:

            def joined() -> None:
                receiver.connect()
                on_network()

            code = run_monitor(
                self._config,
                out=out,
                stop=stop,
                recording_name="demo",
                truth_tcp_m=truth_tcp_m,
                on_network=joined,
                view=view,
            )
        return code, _summarise(out, self._simulator, receiver.count)


def _free_port() -> int:
    """Zenoh's usual port, or any other that is free when a program has that one."""
    for port in (_PREFERRED_PORT, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise NoResultError("demo: no TCP port is free on 127.0.0.1; one is needed for Zenoh")


class _Receiver(AbstractContextManager["_Receiver"]):
    """A second Zenoh session that counts the transforms that arrive, calling ``step`` for each."""

    def __init__(self, config: Config, step: Callable[[], None]):
        self.count = 0
        self._config = config
        self._step = step
        self._client: Client | None = None

    def connect(self) -> None:
        """Join the network and wait until the monitor is seen there."""
        settings = self._config.settings
        self._client = Client(settings.robot, settings.camera_name, connect=settings.publish.listen, depth=1024)
        self._client.on_transform(self._arrived)
        deadline_s = time.monotonic() + _CONNECT_S
        while not self._client.alive(timeout_s=0.2) and time.monotonic() < deadline_s:
            time.sleep(0.02)

    def __exit__(self, *_exception: object) -> None:
        if self._client is not None:
            self._client.close()

    def _arrived(self, _record: FrameRecord) -> None:
        self.count += 1
        self._step()


def _summarise(out: Path, simulator: Simulator, received: int) -> DemoSummary | None:
    """Compare ``estimates.jsonl`` with the truth, and write ``summary.json``."""
    estimates = out / "estimates.jsonl"
    decode = msgspec.json.Decoder(FrameRecord).decode
    records = [decode(line) for line in estimates.read_bytes().splitlines()] if estimates.exists() else []
    if not records:
        return None
    latencies_ms = 1e-6 * np.array([record.latency_ns for record in records])
    span_s = 1e-9 * (records[-1].stamp_ns - records[0].stamp_ns)
    summary = DemoSummary(
        frames=len(records),
        frames_dropped=records[-1].seq + 1 - len(records),
        frames_per_s=(len(records) - 1) / span_s if span_s > 0.0 else None,
        transforms_received=received,
        latency_ms=_latency(latencies_ms),
        latency_while_tracking_ms=_latency(latencies_ms[[r.state in _TRACKING for r in records]]),
        recordings=tuple(sorted(path.name for path in out.glob("*.rrd"))),
        comparison=compare(records, simulator.truth),
    )
    text = json.dumps(msgspec.to_builtins(summary), indent=2) + "\n"
    (out / "summary.json").write_text(text, encoding="utf-8")
    return summary


def _latency(latencies_ms: Array) -> Latency:
    if not latencies_ms.size:
        return Latency(None, None)
    return Latency(float(np.median(latencies_ms)), float(np.percentile(latencies_ms, 99.0)))
