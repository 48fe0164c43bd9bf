"""``gripmon simulate``: images of a simulated wrist camera with exact truth, ready for ``gripmon replay``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from gripmon.cli import common
from gripmon.model.errors import InputError

_DESCRIPTION = """\
Write a simulated sequence: one PNG a frame, timestamps.csv (file, stamp_ns, jaw_opening_m as the robot
reports it), truth.jsonl (per frame cam_T_grip, TCP shift, jaw opening, corner pixels and what hides
them; m, px), and config.yaml with gripper.yaml, so that gripmon replay works at once.  The same seed
gives the same images."""

_EXAMPLES = """\
  gripmon simulate --list
  gripmon simulate bump --out bump/ --seed 3
  gripmon simulate creep --out creep/ --seconds 60 --fps 10
  gripmon simulate my_scenario.yaml --config my_robot.yaml --out mine/
  gripmon replay bump/ --config bump/config.yaml --out bump.jsonl"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "simulate", run, "write simulated images with exact truth", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("scenario", nargs="?", metavar="SCENARIO", help="a built-in name (see --list) or a YAML file")
    parser.add_argument("--out", metavar="DIR", help="folder to write to; made if it is missing, refused if not empty")
    parser.add_argument("--seed", type=common.seed, default=0, metavar="N", help="random seed, 0 or more (default 0)")
    parser.add_argument(
        "--config",
        metavar="CONFIG",
        help="take camera, gripper and calibration from this configuration (default: those of gripmon demo)",
    )
    parser.add_argument(
        "--seconds", type=common.positive_number, metavar="S", help="scale a built-in scenario to this length (s)"
    )
    parser.add_argument(
        "--fps", type=common.positive_number, metavar="HZ", help="frames a second of a built-in one (1/s)"
    )
    parser.add_argument("--list", action="store_true", help="print the names of the built-in scenarios, and stop")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon simulate``."""
    from gripmon.daemon.simulating import simulate_images
    from gripmon.simulate import SCENARIO_NAMES

    if arguments.list:
        print("\n".join(SCENARIO_NAMES))
        return common.EXIT_DONE
    if arguments.scenario is None or arguments.out is None:
        raise InputError("simulate: SCENARIO and --out DIR are needed; e.g. gripmon simulate bump --out bump/")
    out = Path(arguments.out)
    config = common.load_demo_or(arguments.config)
    with common.progress_bar(None, "frame") as step:
        sequence = simulate_images(
            arguments.scenario,
            out,
            config=config,
            seed=arguments.seed,
            duration_s=arguments.seconds,
            fps=arguments.fps,
            step=lambda _done, total: step(total),
        )
    replay = shlex.join(["gripmon", "replay", str(out), "--config", str(sequence.config), "--out", f"{out}.jsonl"])
    print(f"{sequence.frames} frames in {out}; next: {replay}")
    return common.EXIT_DONE
