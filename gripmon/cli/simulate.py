"""``gripmon simulate``: images of a simulated wrist camera with exact truth, ready for ``gripmon replay``."""

from __future__ import annotations

import argparse
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon import __version__
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.simulate import Scenario

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
    from gripmon.simulate import CALIBRATION_KINDS, SCENARIO_NAMES, Simulator, write_sequence

    if arguments.list:
        print("\n".join((*SCENARIO_NAMES, *CALIBRATION_KINDS)))
        return common.EXIT_DONE
    if arguments.scenario is None or arguments.out is None:
        raise common.CommandFailedError(
            "simulate: SCENARIO and --out DIR are needed; e.g. gripmon simulate bump --out bump/", common.EXIT_USAGE
        )
    config = common.load_demo_or(arguments.config)
    if arguments.scenario in CALIBRATION_KINDS:
        return _calibration_images(arguments, config)
    scenario = _scenario(arguments, config)
    out = _empty_directory(Path(arguments.out))
    try:
        simulator = Simulator(config.camera, config.gripper, config.cam_T_grip, scenario, arguments.seed)
    except ValueError as error:
        raise common.CommandFailedError(f"{arguments.scenario}: {error}", common.EXIT_USAGE) from None
    makes_its_own = arguments.scenario == "work"  # the walk's earlier steps make gripper, calibration and configuration
    if not makes_its_own:
        shutil.copyfile(config.gripper_path, out / "gripper.yaml")
        (out / "config.yaml").write_text(_config_text(config, scenario, arguments), encoding="utf-8")
    with common.progress_bar(simulator.frame_count, "frame") as step:
        count = write_sequence(simulator, out, lambda _done, _total: step())
    follows = ["gripmon", "replay", str(out), "--config", str(out / "config.yaml"), "--out", f"{out}.jsonl"]
    if makes_its_own:
        follows = ["gripmon", "teach", str(out / "000000.png"), *_TEACH]
    print(f"{count} frames in {out}; next: {shlex.join(follows)}")
    return common.EXIT_DONE


_TEACH = shlex.split(
    "--corners standing/rough.yaml --camera camera.yaml --gripper gripper.yaml --reference hand_eye.yaml --robot arm1 "
    "--out mine"
)


def _calibration_images(arguments: argparse.Namespace, config: Config) -> int:
    """What the calibrations start from, and the command that takes it."""
    from gripmon.simulate import Rig, image_count, write_calibration_images

    kind = arguments.scenario
    if arguments.seconds is not None or arguments.fps is not None:
        raise common.CommandFailedError(
            f"simulate: {kind} is single images; neither --seconds nor --fps", common.EXIT_USAGE
        )
    out = _empty_directory(Path(arguments.out))
    rig = Rig(config.camera, config.gripper, config.cam_T_grip)
    with common.progress_bar(image_count(kind), "image") as step:
        try:
            write_calibration_images(kind, rig, out, arguments.seed, step)
        except ValueError as error:
            raise common.CommandFailedError(f"simulate {kind}: {error}", common.EXIT_USAGE) from None
    print(f"{image_count(kind)} images in {out}; next: {_next_step(kind, shlex.quote(str(out)), config)}")
    return common.EXIT_DONE


def _next_step(kind: str, folder: str, config: Config) -> str:
    from gripmon.model.targets import name_of
    from gripmon.simulate.calibration_images import BOARD, PLATE, SECOND_PLATE

    gripper = config.gripper
    jaw = f"--jaw-range {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g} " if gripper.has_jaw else ""
    return {
        "plate": f"gripmon calibrate intrinsics {folder} --target {name_of(PLATE)} --model paper --out camera.yaml",
        "standing": f"gripmon calibrate plane {folder} --target camera.yaml --camera camera.yaml --corners "
        f"{folder}/rough.yaml --infer {jaw}--gripper-out gripper.yaml --out hand_eye.yaml",
        "robot_world": f"gripmon calibrate robot-world {folder}/views.csv --camera camera.yaml --target "
        f"{name_of(BOARD)} --eye-in-hand --out robot_world.yaml",
        "spots": f"gripmon calibrate intrinsics {folder}/plate --target {name_of(SECOND_PLATE)} --out second.yaml, "
        f"then gripmon calibrate laser {folder}/spots.csv --camera second.yaml --out laser.yaml",
    }[kind]


def _scenario(arguments: argparse.Namespace, config: Config) -> Scenario:
    from gripmon.daemon.config import ConfigError, load_scenario
    from gripmon.simulate import CALIBRATION_KINDS, SCENARIO_NAMES, Rig, make_scenario

    name: str = arguments.scenario
    if Path(name).suffix in (".yaml", ".yml"):
        if arguments.seconds is not None or arguments.fps is not None:
            raise common.CommandFailedError(
                f"{name}: --seconds and --fps are for built-in scenarios; duration_s and fps in the file",
                common.EXIT_USAGE,
            )
        try:
            return load_scenario(Path(name))
        except ConfigError as error:
            raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    if name not in SCENARIO_NAMES:
        known = ", ".join((*SCENARIO_NAMES, *CALIBRATION_KINDS))
        raise common.CommandFailedError(f"simulate: there is no '{name}'; one of {known}", common.EXIT_USAGE)
    try:
        return make_scenario(
            name,
            duration_s=arguments.seconds,
            fps=arguments.fps,
            finger=config.gripper.finger_ids[0],
            jaw_opening_m=Rig(config.camera, config.gripper, config.cam_T_grip).jaw_opening_m,
        )
    except ValueError as error:
        raise common.CommandFailedError(f"simulate: {error}", common.EXIT_USAGE) from None


def _empty_directory(path: Path) -> Path:
    common.make_directory(path)
    if any(path.iterdir()):
        raise common.CommandFailedError(f"--out {path}: is not empty; a new or empty folder", common.EXIT_USAGE)
    return path


def _config_text(config: Config, scenario: Scenario, arguments: argparse.Namespace) -> str:
    """A configuration for the sequence, commented, in the form of the hand-written ones."""
    import msgspec

    camera = msgspec.to_builtins(config.settings.camera)
    x, y, z, w = config.reference.cam_T_grip.rotation_xyzw
    lens = "\n".join(f"  {key}: {_yaml(value)}  # {_LENS_UNITS[key]}" for key, value in camera.items())
    jaw = "frames" if config.gripper.has_jaw and scenario.jaw.reported else "fixed"
    return f"""\
# Written by: gripmon simulate {scenario.name} --seed {arguments.seed} (gripmon {__version__})
robot: simulated  # name of the robot in the Zenoh keys
camera_name: wrist  # name of the camera in the Zenoh keys
camera:
{lens}
gripper: gripper.yaml  # path of the gripper file, relative to this file
reference:
  cam_T_grip:  # what a perfect calibration gave at the beginning: maps gripper coordinates to camera coordinates
    translation_m: {_yaml(list(config.reference.cam_T_grip.translation_m))}  # x, y, z (m)
    rotation_xyzw: {_yaml([x, y, z, w])}  # unit quaternion x, y, z, w
jaw:
  source: {jaw}  # the opening comes with each frame (timestamps.csv), or is the nominal one if fixed
source:
  kind: folder  # images in a folder
  path: .  # the folder, relative to this file
"""


_LENS_UNITS = {
    "model": "lens model: paper, brown_conrady or fisheye",
    "width_px": "image width (px)",
    "height_px": "image height (px)",
    "fx_px": "focal length over the pixel's width (px)",
    "fy_px": "focal length over the pixel's height (px)",
    "cx_px": "column of the principal point (px)",
    "cy_px": "row of the principal point (px)",
    "kappa_per_px2": "radial distortion (1/px²)",
    "coefficients": "distortion in OpenCV's order (no unit)",
}


def _yaml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return repr(value) if isinstance(value, float) else str(value)
