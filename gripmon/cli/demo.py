"""``gripmon demo``: the whole daemon on a simulated wrist camera, and what it made of it against the truth."""

from __future__ import annotations

import argparse
import shlex
import shutil
import socket
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common, viewing
from gripmon.cli.run import run_daemon
from gripmon.model.stopping import signals_exit

if TYPE_CHECKING:
    from gripmon.cli.comparison import Comparison, Distribution, EventReport, TcpErrors
    from gripmon.client import Client
    from gripmon.daemon.config import Config
    from gripmon.model.records import Array, FrameRecord
    from gripmon.simulate import Simulator

_DESCRIPTION = """\
Run the whole daemon on a simulated wrist camera: a cable pulls the camera aside (creep), a collision
knocks it by 4.5 mm (bump), a hand covers the view (occlusion).  Transforms are published over Zenoh
within this process and received back, everything is recorded, and at the end the corrected
position of the tool centre point (TCP) is compared with the truth (mm).

DIR gets demo-0001.rrd (the recording), estimates.jsonl (one JSON line a frame) and summary.json."""

_EXAMPLES = """\
  gripmon demo
  gripmon demo --seconds 60 --out demo/
  gripmon demo --fps 25                  on a slow machine

exit codes: 0 done; 2 wrong usage; 3 no usable frame; 130 interrupted"""

_PREFERRED_PORT = 7447
_CONNECT_S = 5.0
_TRACKING = ("tracking", "drifting")
_SHORTEST_S = 4.0


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "demo", run, "everything at work on a simulated camera", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "--seconds",
        type=common.positive_number,
        default=20.0,
        metavar="S",
        help=f"length; its events are spread over it (s; default 20, at least {_SHORTEST_S:g})",
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: gripmon-demo-DATE-TIME here)")
    parser.add_argument(
        "--fps", type=common.positive_number, metavar="HZ", help="frame rate of the camera (1/s; default 60)"
    )
    parser.add_argument(
        "--seed", type=common.seed, default=1, metavar="N", help="random seed of the simulation (default 1)"
    )
    viewing.add_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon demo``."""
    if arguments.seconds < _SHORTEST_S:
        raise common.CommandFailedError(
            f"demo: --seconds {arguments.seconds:g} is too short for its events; at least {_SHORTEST_S:g}",
            common.EXIT_USAGE,
        )
    config = _demo_config(arguments)
    from gripmon.io.sources import SimulatedSettings, SourceError, make_simulator

    assert isinstance(config.settings.source, SimulatedSettings), "the shipped demo.yaml has a simulated camera"
    try:
        simulator = make_simulator(config.settings.source, config.scene, config.directory)
    except SourceError as error:
        raise common.CommandFailedError(f"demo: {error}", common.EXIT_USAGE) from None
    out = common.make_directory(Path(arguments.out or f"gripmon-demo-{time.strftime('%Y%m%d-%H%M%S')}"))
    print(
        f"{arguments.seconds:g} s of a simulated wrist camera; transforms on {_endpoint(config)}; results in {out}",
        file=sys.stderr,
    )
    bar = common.progress_bar(simulator.frame_count, "frame")
    with (
        signals_exit() as stop,
        bar as step,
        _Receiver(config, step) as receiver,
        ExitStack() as messages,
    ):

        def truth_tcp_m(seq: int) -> tuple[float, float, float]:
            x, y, z = simulator.truth(seq).cam_T_grip[:3, 3].tolist()
            return x, y, z

        def on_network() -> None:
            receiver.connect()
            messages.enter_context(common.messages_above_bar("gripmon"))

        code = run_daemon(
            config,
            out=out,
            stop=stop,
            recording_name="demo",
            truth_tcp_m=truth_tcp_m,
            on_network=on_network,
            view=arguments.view,
        )
    _summarise(out, simulator, receiver.count)
    return code


def _demo_config(arguments: argparse.Namespace) -> Config:
    """The shipped configuration, with the length asked for and a port that is free."""
    import dataclasses

    import msgspec

    config = common.load_demo_or(None)
    settings = config.settings
    changes: dict[str, Any] = {"duration_s": arguments.seconds, "ends": True, "seed": arguments.seed}
    if arguments.fps is not None:
        changes["fps"] = arguments.fps
    try:
        source = msgspec.convert(msgspec.to_builtins(settings.source) | changes, type(settings.source))
    except msgspec.ValidationError as error:
        raise common.CommandFailedError(f"demo: {error}", common.EXIT_USAGE) from None
    publish = msgspec.structs.replace(settings.publish, listen=(f"tcp/127.0.0.1:{_free_port()}",))
    view = settings.view
    if arguments.view is not None:
        from gripmon.record.write.viewer import free_port

        view = msgspec.structs.replace(view, port=free_port(view.port), web_port=free_port(view.web_port))
    settings = msgspec.structs.replace(settings, source=source, publish=publish, view=view)
    return dataclasses.replace(config, settings=settings)


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
    raise common.CommandFailedError("demo: no TCP port is free on 127.0.0.1; one is needed for Zenoh")


def _endpoint(config: Config) -> str:
    settings = config.settings
    return f"{settings.publish.listen[0]}, key gripmon/{settings.robot}/{settings.camera_name}/transform"


class _Receiver(AbstractContextManager["_Receiver"]):
    """A second Zenoh session that counts the transforms that arrive, calling ``step`` for each."""

    def __init__(self, config: Config, step: Callable[[], None]):
        self.count = 0
        self._config = config
        self._step = step
        self._client: Client | None = None

    def connect(self) -> None:
        """Join the network and wait until the monitor is seen there."""
        from gripmon.client import Client

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


def _summarise(out: Path, simulator: Simulator, received: int) -> None:
    """Compare ``estimates.jsonl`` with the truth, print it, and write ``summary.json``."""
    import json

    import msgspec
    import numpy as np

    from gripmon.cli.comparison import compare
    from gripmon.model.records import FrameRecord

    estimates = out / "estimates.jsonl"
    decode = msgspec.json.Decoder(FrameRecord).decode
    records = [decode(line) for line in estimates.read_bytes().splitlines()] if estimates.exists() else []
    if not records:
        print("demo: no frame was processed", file=sys.stderr)
        return
    comparison = compare(records, simulator.truth)
    latencies_ms = 1e-6 * np.array([record.latency_ns for record in records])
    span_s = 1e-9 * (records[-1].stamp_ns - records[0].stamp_ns)
    summary = {
        "frames": len(records),
        "frames_dropped": records[-1].seq + 1 - len(records),
        "frames_per_s": (len(records) - 1) / span_s if span_s > 0.0 else None,
        "transforms_received": received,
        "latency_ms": _latency(latencies_ms),
        "latency_while_tracking_ms": _latency(latencies_ms[[r.state in _TRACKING for r in records]]),
        "recordings": sorted(path.name for path in out.glob("*.rrd")),
        "comparison": msgspec.to_builtins(comparison),
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(_as_text(summary, comparison, out))


def _as_text(summary: dict[str, Any], comparison: Comparison, out: Path) -> str:
    from gripmon.daemon.config import builtin_config

    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in comparison.verdicts.items() if count)
    configs = shlex.quote(str(builtin_config("live_camera.yaml").parent))
    recordings = [str(out / name) for name in summary["recordings"]]
    return "\n".join(
        [
            "",
            f"{'TCP error against truth (mm)':<38}      across the optical axis           along it",
            f"{'':<38}{'frames':>6}{'mean':>9}{'95 %':>8}{'max':>8}{'mean':>10}{'95 %':>8}{'max':>8}",
            _error_row("without correction", comparison.without_correction),
            _error_row("after correction", comparison.after_correction),
            *(_error_row(f"  {_span(event)}", event.after_correction) for event in comparison.events),
            _error_row("after correction, smoothed", comparison.smoothed),
            "",
            *(_event_line(event) for event in comparison.events),
            "",
            f"frames     {summary['frames']} ({verdicts}), {summary['frames_dropped']} dropped",
            f"Zenoh      {summary['transforms_received']} transforms received",
            f"latency    {_latency_line(summary['latency_ms'])}, from frame to published transform",
            f"           {_latency_line(summary['latency_while_tracking_ms'])} while tracking (else it searches)",
            "",
            f"results    {out / 'estimates.jsonl'}, {out / 'summary.json'}",
            *(f"look at it {_viewer()} {shlex.quote(recording)}" for recording in recordings),
            _report_line(recordings, out),
            f"next       your own camera: cp -r {configs} mine; edit mine/live_camera.yaml;",
            "           gripmon check mine/live_camera.yaml; gripmon run mine/live_camera.yaml",
        ]
    )


def _report_line(recordings: list[str], out: Path) -> str:
    """How to ask what happened."""
    if not recordings:
        return "recording  none was written; the alerts above say why"
    return f"report     gripmon report {shlex.join(recordings)} --out {shlex.quote(str(out / 'report.html'))}"


def _viewer() -> str:
    """How to start rerun's viewer, which is installed with us but perhaps not on the path."""
    beside_us = Path(sys.executable).parent / "rerun"
    return "rerun" if shutil.which("rerun") or not beside_us.exists() else shlex.quote(str(beside_us))


def _latency(latencies_ms: Array) -> dict[str, float | None]:
    import numpy as np

    if not latencies_ms.size:
        return {"median": None, "p99": None}
    return {"median": float(np.median(latencies_ms)), "p99": float(np.percentile(latencies_ms, 99.0))}


def _latency_line(latency_ms: dict[str, float | None]) -> str:
    if latency_ms["median"] is None:
        return "—"
    return f"{latency_ms['median']:.2f} ms median, {latency_ms['p99']:.2f} ms 99 %"


def _span(event: EventReport) -> str:
    return f"{event.event} at {event.start_s:.1f} to {event.end_s:.1f} s"


def _error_row(name: str, errors: TcpErrors) -> str:
    return f"{name:<38}{errors.frames:>6} {_cells(errors.across_mm)}  {_cells(errors.along_mm)}"


def _cells(values: Distribution) -> str:
    return "".join("       —" if v is None else f"{v:8.4f}" for v in (values.mean, values.p95, values.max))


def _event_line(event: EventReport) -> str:
    moved = f"TCP up to {event.largest_tcp_shift_mm:.2f} mm off"
    if event.noticed_after_s is None:
        noticed = "rightly no alarm" if event.harmless else "NOT NOTICED"
    else:
        noticed = f"{'FALSE ALARM' if event.harmless else 'noticed'} after {event.noticed_after_s:.2f} s"
    if event.alerts:
        noticed += f": {', '.join(dict.fromkeys(event.alerts))}"
    return f"{event.event:<10} {moved}; {event.valid} of {event.frames} frames valid; {noticed}"
