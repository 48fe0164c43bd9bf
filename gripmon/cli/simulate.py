"""``gripmon simulate``: images of a simulated wrist camera with exact truth, ready for ``gripmon replay``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.daemon.simulating import SimulatedImages

_DESCRIPTION = """\
Write a simulated sequence: one PNG a frame, timestamps.csv (file, stamp_ns, jaw_opening_m as the robot
reports it), truth.jsonl (per frame cam_T_grip, TCP shift, jaw opening, corner pixels and what hides
them; m, px), and config.yaml with gripper.yaml, so that gripmon replay works at once.  The same seed
gives the same images.

For the way from a new gripper to a running monitor without any hardware, all of one camera and gripper:
plate        a calibration plate, tilted to all sides, for gripmon calibrate intrinsics
standing     the gripper stands on the plate; rough.yaml has its corners as a person would put them
work         the gripper at work before clutter; in the middle something knocks the camera by 0.9 mm
robot_world  a board from many poses of the robot (views.csv), for gripmon calibrate robot-world
spots        a second camera: its plate, laser spots (spots.csv), and spots after a knock (fresh.csv)
truth.json (of work: truth.jsonl) holds the truth beside the images; no step reads it."""

_EXAMPLES = """\
  gripmon simulate --list
  gripmon simulate bump --out bump/ --seed 3
  gripmon simulate creep --out creep/ --seconds 60 --fps 10
  gripmon simulate my_scenario.yaml --config my_robot.yaml --out mine/
  gripmon replay bump/ --config bump/config.yaml --out bump.jsonl

inputs for every step from a new gripper to a running monitor
  gripmon simulate plate --out plate
  gripmon simulate standing --out standing
  gripmon simulate work --out work"""


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
    from gripmon.simulate import CALIBRATION_KINDS, SCENARIO_NAMES

    if arguments.list:
        print("\n".join((*SCENARIO_NAMES, *CALIBRATION_KINDS)))
        return common.EXIT_DONE
    kind = arguments.scenario
    if kind is None or arguments.out is None:
        raise InputError("simulate: SCENARIO and --out DIR are needed; e.g. gripmon simulate bump --out bump/")
    config = common.load_demo_or(arguments.config)
    single = kind in CALIBRATION_KINDS
    with common.progress_bar(None, "image" if single else "frame") as step:
        made = simulate_images(
            kind,
            Path(arguments.out),
            config=config,
            seed=arguments.seed,
            duration_s=arguments.seconds,
            fps=arguments.fps,
            step=lambda _done, total: step(total),
        )
    print(f"{made.frames} {'images' if single else 'frames'} in {made.folder}; next: {_next_step(kind, made, config)}")
    return common.EXIT_DONE


def _next_step(kind: str, made: SimulatedImages, config: Config) -> str:
    """The command that takes these images."""
    from gripmon.model.targets import name_of
    from gripmon.simulate.calibration_images import BOARD, PLATE, SECOND_PLATE

    folder, gripper = shlex.quote(str(made.folder)), config.gripper
    jaw = f"--jaw-range {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g} " if gripper.has_jaw else ""
    follows = {
        "plate": f"gripmon calibrate intrinsics {folder} --target {name_of(PLATE)} --model paper --out camera.yaml",
        "standing": f"gripmon calibrate plane {folder} --target camera.yaml --camera camera.yaml --corners "
        f"{folder}/rough.yaml --infer {jaw}--gripper-out gripper.yaml --out hand_eye.yaml",
        "work": f"gripmon teach {folder}/000000.png --corners standing/rough.yaml --camera camera.yaml "
        "--gripper gripper.yaml --reference hand_eye.yaml --robot arm1 --out mine",
        "robot_world": f"gripmon calibrate robot-world {folder}/views.csv --camera camera.yaml --target "
        f"{name_of(BOARD)} --eye-in-hand --out robot_world.yaml",
        "spots": f"gripmon calibrate intrinsics {folder}/plate --target {name_of(SECOND_PLATE)} --out second.yaml, "
        f"then gripmon calibrate laser {folder}/spots.csv --camera second.yaml --out laser.yaml",
    }
    if made.config is None:
        return follows[kind]
    out = str(made.folder)
    return shlex.join(["gripmon", "replay", out, "--config", str(made.config), "--out", f"{out}.jsonl"])
