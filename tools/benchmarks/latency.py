"""What a frame costs, from handed over to published, and how long the program takes.

Times the daemon's own loop (gripmon.daemon.running.run with a Zenoh publisher and a subscriber in another process) on
simulator frames that were rendered beforehand, beside it, in the same run and on one core, AprilTags on the
fingertips of the same images (cv2.aruco with sub-pixel corners, solvePnP) and ViSP's edge tracker where that is
installed; the whole daemon on a live camera, its demo, replay, starts. Each part is printed as soon as it is measured,
its target beside it. On two quiet cores, which it needs, it takes some eight minutes; --quick, less exact, one and a
half.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

from benchmarks import kit, latency_against, latency_live, latency_loop, latency_program, parts
from benchmarks.kit import Report
from benchmarks.parts import LARGE, Frames, Part

_LOOP = {
    "settle": 60, "frames": 2500, "compared": 1000, "block": 100, "beside": 5, "turns": 2, "turn": 150, "gone": 180,
    "staged": 600,
}  # fmt: skip
_PROGRAM = {"daemon_s": 4.0, "load_s": 4.0, "demo_s": 4.0, "replayed": 200, "starts": 1, "calls": 3}
"""What differs in the plans with --quick."""
_CLUTTER, _QUIET, _LARGE = Frames(), Frames("quiet"), Frames(size=LARGE, count=45, quick=6)
_HIDDEN, _LOST = (Frames(kind, count=150, quick=54) for kind in ("hidden", "lost"))
_loop = partial(Part, plan=latency_loop.Plan(), quick=_LOOP)
_program = partial(Part, plan=latency_program.Plan(), quick=_PROGRAM)
PARTS = {
    "frame": _loop("768 x 576, handed over -> published; memory", latency_loop.frame, frames=(_CLUTTER,)),
    "size": _loop("1920 x 1080 against 768 x 576", latency_loop.size, frames=(_CLUTTER, _LARGE)),
    "clutter": _loop(
        "tags on the fingers in a cluttered scene", partial(latency_loop.against_tags, kind="clutter"),
        frames=(_CLUTTER,),
    ),
    "plain": _loop(
        "tags on the fingers in a plain scene", partial(latency_loop.against_tags, kind="plain"),
        frames=(Frames("plain"),),
    ),
    "visp": _loop("ViSP's edge tracker on the same frames", latency_loop.against_visp, frames=(_CLUTTER,)),
    "unreported": _loop("jaw opening unreported against reported", latency_loop.unreported, frames=(_CLUTTER,)),
    "hidden": _loop("a hand covers the gripper", partial(latency_loop.gone, kind="hidden"), frames=(_HIDDEN,)),
    "lost": _loop("the gripper has left the view", partial(latency_loop.gone, kind="lost"), frames=(_LOST,)),
    "daemon": _program("a live camera at 60 frames/s, with recording", latency_live.daemon, frames=(_QUIET,)),
    "load": _program("the same beside two processes that never sleep", latency_live.load, frames=(_QUIET,)),
    "demo": _program("gripmon demo", latency_program.demo),
    "replay": _program("replay of a folder, decoding aside", latency_program.replay, frames=(_QUIET, _CLUTTER)),
    "start": _program("gripmon run to its first transform", latency_program.start, frames=(_CLUTTER,)),
    "memory": _program("gripmon run above its libraries alone", latency_program.memory, frames=(_CLUTTER,)),
    "commands": _program("gripmon --help, import gripmon", latency_program.commands),
    "profile": _loop("time of each stage of a frame", latency_loop.profile, frames=(_CLUTTER, _HIDDEN)),
}  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parts.add_options(parser, "a shorter run")
    parser.add_argument(
        "--daemon-s", type=kit.positive, metavar="S", help="length of the daemon's run, s (default 60, --quick 4)"
    )
    parser.add_argument(
        "--against", metavar="REV",
        help="only this: the frame and its stages beside another revision's, in alternating blocks of one run; exit "
        "code 1 if a frame takes longer",
    )  # fmt: skip


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    if arguments.against is not None:
        latency_against.run(arguments.against, arguments.quick, report)
        return None
    every = PARTS
    if arguments.daemon_s is not None:
        changed = {"daemon_s": float(arguments.daemon_s)}
        every = {
            name: replace(part, plan=replace(part.plan, **changed), quick=part.quick | changed)
            if part.plan is _program.keywords["plan"] else part
            for name, part in PARTS.items()
        }  # fmt: skip
    return parts.run(arguments, report, every)
