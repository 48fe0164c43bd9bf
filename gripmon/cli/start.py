"""First steps: ``gripmon setup``, ``target``, ``simulate`` and ``demo``."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    PAGE_PORT,
    PORT_OPTIONS,
    VIEW,
    VIEW_OPTION,
    Arguments,
    Command,
    announcer,
    check_file,
    make_directory,
    messages_above_bar,
    positive_number,
    progress_bar,
    seed,
)
from gripmon.model.errors import InputError
from gripmon.model.stopping import EXIT_FAILED, signals_exit

if TYPE_CHECKING:
    from gripmon.daemon.simulated import DemoSummary, Latency

_SETUP_OPTIONS = f"""
[DIR]            folder of the set-up; created if missing (default: this one)
--source SOURCE  the camera: 0, /dev/video0, a URL, a folder of images, zenoh:WIDTHxHEIGHT[:KEY] or
                 ros2:WIDTHxHEIGHT:TOPIC; with --step plate, standing or teaching: the source of its images
--step NAME      without a page: carry out this step with the entries in the folder's setup.yaml; camera, target,
                 plate, intrinsics, gripper, standing, corners, reference, teaching, teach, check or run
{PORT_OPTIONS.strip()}
"""

_SETUP_EXAMPLES = """\
  gripmon setup arm1
  gripmon setup arm1 --source 0
  gripmon setup arm1 --step plate        take images of the target automatically, without a page

exit codes: 0 done; 2 wrong usage or files; 3 a step has no result, with the reason; 130 Ctrl-C"""


@Command(
    _SETUP_OPTIONS, _SETUP_EXAMPLES, dir={"default": Path()},
    port=PAGE_PORT,
)  # fmt: skip
def setup(arguments: Arguments) -> None:
    """Lead from a camera to a running monitor on a local web page: camera, printed target, images of it,
    lens, gripper, hand/eye calibration, teaching, forecast, start.  Every step shows a command and writes
    the same file as that command to the folder; call again with the same folder to continue.
    """
    from gripmon.daemon.setup import Project, SetupSite
    from gripmon.teach.page_server import serve

    folder, source = make_directory(arguments.dir, "DIR"), arguments.source
    if source is not None and not source.isdecimal() and not Path(source).is_absolute() and Path(source).exists():
        source = os.path.relpath(os.path.realpath(source), os.path.realpath(folder))  # stored relative to the folder
    with contextlib.chdir(folder):
        project = Project(Path())
        project.keep({} if source is None else {project.source_field(arguments.step): source})
        if arguments.step is not None:
            print("\n".join(f"{line.level:<5} {line.text}".strip() for line in project.do_here(arguments.step, print)))
            return
        with contextlib.closing(SetupSite(project)) as site:
            serve(site, arguments.port, announcer("set up"), open_browser=not arguments.no_browser)


_TARGET_OPTIONS = """
[TARGET]      as for gripmon calibrate intrinsics --target (default: circles:12x10:0.008:0.004)
--pdf FILE    file to write
--paper SIZE  a5 to a0, letter, legal, tabloid, or WIDTHxHEIGHT in mm (default: a4)
--force       replace an existing file
"""

_TARGET_EXAMPLES = """\
  gripmon target --pdf plate.pdf
  gripmon target charuco:8x6:0.03:0.022 --paper letter --pdf board.pdf
  gripmon target chequerboard:20x14:0.025 --paper 600x420 --pdf large.pdf

exit codes: 0 written; 2 wrong usage, or the target doesn't fit on the paper"""


@Command(
    _TARGET_OPTIONS, _TARGET_EXAMPLES,
    target={"default": "circles:12x10:0.008:0.004"}, pdf={"required": True}, paper={"default": "a4"},
)  # fmt: skip
def target(arguments: Arguments) -> None:
    """Write a calibration target as a page to print: PDF in true size, with a bar to check it with a ruler.
    The page also shows its name for --target.
    """
    from gripmon.calibrate.target_print import print_target
    from gripmon.model.targets import parse_target

    if arguments.pdf.suffix.lower() != ".pdf":
        raise InputError(f"--pdf {arguments.pdf}: isn't the name of a PDF; FILE.pdf")
    made = print_target(parse_target(arguments.target), arguments.paper)
    arguments.check_outputs("pdf")
    arguments.save("pdf", made.pdf)
    print(f"print at 100 %; the bar has to measure {made.bar_mm:g} mm\nwritten: {arguments.pdf}")


_SIMULATE_OPTIONS = """
[SCENARIO]       a built-in name (see --list) or a YAML file
--out DIR        folder to write to; created if missing, refused if not empty
--seed N         random seed, 0 or more (default 0)
--config CONFIG  take camera, gripper and calibration from this configuration (default: those of gripmon demo)
--seconds S      scale a built-in scenario to this length (s)
--fps HZ         frame rate of a built-in scenario (1/s)
--list           print the names of the built-in scenarios
"""

_SIMULATE_EXAMPLES = """\
  gripmon simulate --list
  gripmon simulate bump --out bump/ --seed 3
  gripmon simulate creep --out creep/ --seconds 60 --fps 10
  gripmon simulate my_scenario.yaml --config my_robot.yaml --out mine/
  gripmon replay bump/ --config bump/config.yaml --out bump.jsonl

inputs for every step from a new gripper to a running monitor
  gripmon simulate plate --out plate
  gripmon simulate standing --out standing
  gripmon simulate work --out work"""


@Command(
    _SIMULATE_OPTIONS, _SIMULATE_EXAMPLES, seed={"type": seed, "default": 0},
    seconds=positive_number, fps=positive_number,
)  # fmt: skip
def simulate(arguments: Arguments) -> None:
    """Write a simulated sequence: one PNG per frame, timestamps.csv (file, stamp_ns, jaw_opening_m as reported
    by the robot), truth.jsonl (per frame cam_T_grip, TCP shift, jaw opening, corner pixels and what hides
    them; m, px), and config.yaml with gripper.yaml, ready for gripmon replay.  The same seed gives the same
    images.

    For all steps from a new gripper to a running monitor without hardware, with one camera and gripper:
    plate        a calibration plate, tilted to all sides, for gripmon calibrate intrinsics
    standing     the gripper stands on the plate; rough.yaml has its corners as a person would mark them
    work         the gripper at work before clutter; in the middle something knocks the camera by 0.9 mm
    robot_world  a board from many poses of the robot (views.csv), for gripmon calibrate robot-world
    spots        a second camera: its plate, laser spots (spots.csv), and spots after a knock (fresh.csv)
    truth.json (of work: truth.jsonl) holds the truth beside the images; no step reads it.
    """
    from gripmon.daemon.config import builtin_config, load_config
    from gripmon.daemon.simulated import next_step, simulate_images
    from gripmon.simulate import CALIBRATION_KINDS, SCENARIO_NAMES

    if arguments.list:
        print("\n".join((*SCENARIO_NAMES, *CALIBRATION_KINDS)))
        return
    kind = arguments.scenario
    if kind is None or arguments.out is None:
        raise InputError("simulate: SCENARIO and --out DIR are needed; e.g. gripmon simulate bump --out bump/")
    config = load_config(arguments.config or builtin_config("demo.yaml"), check_source=False)
    unit = "image" if kind in CALIBRATION_KINDS else "frame"
    with progress_bar(None, unit) as step:
        made = simulate_images(
            kind, arguments.out, config=config, seed=arguments.seed, duration_s=arguments.seconds, fps=arguments.fps,
            step=lambda _done, total: step(total),
        )  # fmt: skip
    print(f"{made.frames} {unit}s in {made.folder}; next: {next_step(kind, made, config.gripper)}")


_SHORTEST_S = 4.0

_DEMO_OPTIONS = f"""
--seconds S  length, over which the events are spread (s; default 20, at least {_SHORTEST_S:g})
--out DIR    folder for the results (default: gripmon-demo-DATE-TIME here)
--fps HZ     frame rate of the camera (1/s; default: 60, 30 or 15, whatever this machine can keep)
--seed N     random seed of the simulation (default 1)
{VIEW_OPTION.strip()}
"""

_DEMO_EXAMPLES = """\
  gripmon demo
  gripmon demo --seconds 60 --out demo/
  gripmon demo --fps 25

exit codes: 0 done; 2 wrong usage; 3 no usable frame, or none could be written; 130 interrupted"""


@Command(
    _DEMO_OPTIONS, _DEMO_EXAMPLES,
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
        print(f"demo: no frame is in {out / 'estimates.jsonl'}; the log above says why", file=sys.stderr)
        return code or EXIT_FAILED
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
