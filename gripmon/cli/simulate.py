"""``gripmon simulate``: images of a simulated wrist camera with exact truth, ready for ``gripmon replay``."""

from __future__ import annotations

from gripmon.cli.common import Arguments, Command, positive_number, progress_bar, seed
from gripmon.model.errors import InputError

_OPTIONS = """
[SCENARIO]       a built-in name (see --list) or a YAML file
--out DIR        folder to write to; created if missing, refused if not empty
--seed N         random seed, 0 or more (default 0)
--config CONFIG  take camera, gripper and calibration from this configuration (default: those of gripmon demo)
--seconds S      scale a built-in scenario to this length (s)
--fps HZ         frame rate of a built-in scenario (1/s)
--list           print the names of the built-in scenarios
"""

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


@Command(
    _OPTIONS, _EXAMPLES, seed={"type": seed, "default": 0},
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
