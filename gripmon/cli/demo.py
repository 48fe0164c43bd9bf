"""``gripmon demo``: the whole daemon on a simulated wrist camera, compared with the truth."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    Arguments,
    Command,
    check_file,
    make_directory,
    messages_above_bar,
    positive_number,
    progress_bar,
    seed,
)
from gripmon.cli.run import VIEW, VIEW_OPTION
from gripmon.model.errors import InputError
from gripmon.model.stopping import signals_exit

if TYPE_CHECKING:
    from gripmon.daemon.simulated import DemoSummary, Latency

_SHORTEST_S = 4.0

_OPTIONS = f"""
--seconds S  length, over which the events are spread (s; default 20, at least {_SHORTEST_S:g})
--out DIR    folder for the results (default: gripmon-demo-DATE-TIME here)
--fps HZ     frame rate of the camera (1/s; default: 60, 30 or 15, whatever this machine can keep)
--seed N     random seed of the simulation (default 1)
{VIEW_OPTION.strip()}
"""

_EXAMPLES = """\
  gripmon demo
  gripmon demo --seconds 60 --out demo/
  gripmon demo --fps 25

exit codes: 0 done; 2 wrong usage; 3 no usable frame; 130 interrupted"""


@Command(
    _OPTIONS, _EXAMPLES,
    seconds={"type": positive_number, "default": 20.0}, fps=positive_number, seed={"type": seed, "default": 1},
    view=VIEW,
)  # fmt: skip
def demo(arguments: Arguments) -> int:
    """Run the whole daemon on a simulated wrist camera: a cable pulls the camera aside (creep), a collision
    knocks it by 4.5 mm (bump), a hand covers the view (occlusion).  Before it begins, it measures what
    this machine can render and process, and chooses the camera's frame rate.  Transforms are published over Zenoh
    within this process and received back, everything is recorded, and at the end the corrected
    position of the tool centre point (TCP) is compared with the truth (mm).

    DIR gets demo-0001.rrd (the recording), estimates.jsonl (one JSON line per frame) and summary.json.
    """
    if arguments.seconds < _SHORTEST_S:
        raise InputError(f"demo: --seconds {arguments.seconds:g} is too short for its events; at least {_SHORTEST_S:g}")
    from gripmon.daemon.service import log_to_stderr
    from gripmon.daemon.simulated import Demo, at_own_pace, demo_config
    from gripmon.monitor import warm_up

    config = demo_config(arguments.seconds, fps=arguments.fps, seed=arguments.seed, viewed=arguments.view is not None)
    Demo(config)  # refuses impossible scenarios before anything takes time
    out = make_directory(arguments.out or Path(f"gripmon-demo-{time.strftime('%Y%m%d-%H%M%S')}"))
    check_file(out / "estimates.jsonl")
    settings = config.settings
    where = f"{settings.publish.listen[0]}, key gripmon/{settings.robot}/{settings.camera_name}/transform"
    length = f"{arguments.seconds:g} s of a simulated wrist camera"
    print(f"{length}; transforms on {where}; results in {out}", file=sys.stderr)
    with signals_exit() as stop, ExitStack() as messages:
        log_to_stderr()
        if compiled := warm_up():
            print(compiled, file=sys.stderr)
        if arguments.fps is None:
            print("trying for some seconds how fast this machine is …", file=sys.stderr)
            config, pace = at_own_pace(config)
            print(pace.text(), file=sys.stderr)
        demo = Demo(config)
        step = messages.enter_context(progress_bar(demo.frame_count, "frame"))
        code, summary = demo.run(
            out, step=step, on_network=lambda: messages.enter_context(messages_above_bar("gripmon")),
            view=arguments.view, stop=stop,
        )  # fmt: skip
    if summary is None:
        print("demo: no frame was processed", file=sys.stderr)
    else:
        print(_as_text(summary, out))
    return code


def _as_text(summary: DemoSummary, out: Path) -> str:
    comparison = summary.comparison
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in comparison.verdicts.items() if count)
    recordings = [str(out / name) for name in summary.recordings]
    return "\n".join(
        [
            "",
            *([f"{summary.caution}", ""] if summary.caution else []),
            *comparison.table(),
            "",
            *(event.text() for event in comparison.events),
            "",
            f"frames     {summary.frames} ({verdicts}), {summary.frames_dropped} dropped",
            f"camera     {summary.camera_fps:g} frames/s{'' if summary.live else ', each when the monitor was ready'}",
            f"Zenoh      {summary.transforms_received} transforms received",
            f"latency    {_latency_line(summary.latency_ms)}, from frame to published transform",
            f"           {_latency_line(summary.latency_while_tracking_ms)} while tracking (not searching)",
            "",
            f"results    {out / 'estimates.jsonl'}, {out / 'summary.json'}",
            *(f"look at it {_beside_us('rerun')} {shlex.quote(recording)}" for recording in recordings),
            _report_line(recordings, out),
            f"next       your own camera and gripper, on one page: {_beside_us('gripmon')} setup arm1",
        ]
    )


def _report_line(recordings: list[str], out: Path) -> str:
    """The command for a report."""
    if not recordings:
        return "recording  none was written; the alerts above say why"
    page = shlex.quote(str(out / "report.html"))
    return f"report     {_beside_us('gripmon')} report {shlex.join(recordings)} --out {page}"


def _beside_us(name: str) -> str:
    """How to start a program of our environment, which may not be on the path."""
    beside_us = Path(sys.executable).parent / name
    return name if shutil.which(name) or not beside_us.exists() else shlex.quote(str(beside_us))


def _latency_line(latency_ms: Latency) -> str:
    if latency_ms.median is None:
        return "—"
    return f"{latency_ms.median:.2f} ms median, {latency_ms.p99:.2f} ms 99 %"
