"""A dataset of simulated episodes with exact truth: three mountings, two episodes in which the camera moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gripmon.daemon.config import Config, builtin_config, load_config
from gripmon.model.camera import PaperLens
from gripmon.model.geometry import perturb
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Bump
from support.episode_files import Shots, write_lerobot, write_mcap

FPS = 10
FRAMES, MOVED_FRAMES = 50, 100
MOUNTINGS = np.array(
    [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.002, 0.001, 0.0, 0.0, 0.0, 0.01], [-0.002, 0.001, 0.002, 0.01, 0.01, 0.0]]
)
"""Against the configuration's reference: position (m), rotation (rad)."""
MOTION_M = (0.0012, 0.0, 0.0004)
LENS = PaperLens(width_px=384, height_px=288, fx_px=481.0, fy_px=481.0, cx_px=191.5, cy_px=143.5)
CONFIG = """\
robot: fleet
camera_name: wrist
camera: {{model: paper, width_px: 384, height_px: 288, fx_px: 481.0, fy_px: 481.0, cx_px: 191.5, cy_px: 143.5}}
gripper: {gripper}
reference:
  cam_T_grip: {{translation_m: [0.0004, 0.0014, 0.1188], rotation_xyzw: [0.267184, 0.003984, -0.001105, 0.963637]}}
jaw: {{source: frames}}
source: {source}
monitor:
  jaw_sigma_m: 0.0
  recalibration: {{sure_sigma_m: 1.0e-4}}
"""
OF_LEROBOT = "{kind: lerobot, path: set, opening: {joints: [gripper], scale: 0.08}}"
OF_BAGS = "{kind: bag, path: bags, opening: {joints: [left, right]}}"


@dataclass(frozen=True)
class Truth:
    """Of an episode: its mounting (0, 1, 2), the transform (4, 4) at its beginning and end, when it moved (s)."""

    mounting: int
    first_T: np.ndarray
    last_T: np.ndarray
    moved_at_s: float | None


def write_config(path: Path, source: str) -> Config:
    gripper = builtin_config("grippers/two_box_fingers.yaml")
    path.write_text(CONFIG.format(gripper=gripper, source=source))
    return load_config(path, check_source=False)


def episode(config: Config, number: int, mounting: int, *, moves: bool = False, seed: int = 0) -> tuple[Shots, Truth]:
    """Rendered with its own background, light and noise."""
    count = MOVED_FRAMES if moves else FRAMES
    at_s = 0.5 * count / FPS
    mount = (Bump(at_s=at_s - 0.05, translation_m=MOTION_M, ring_fraction=0.0),) if moves else ()
    scenario = Scenario(
        name="episode", duration_s=count / FPS, fps=float(FPS), mount=mount,
        start_ns=1_790_000_000_000_000_000 + number * 3_600_000_000_000,
    )  # fmt: skip
    cam_T_grip = perturb(config.cam_T_grip, MOUNTINGS[mounting])
    simulator = paper_rig(config.gripper, cam_T_grip, LENS).simulator(scenario, 100 * seed + number)
    frames = [simulator.frame(i) for i in range(simulator.frame_count)]
    shots = Shots(
        [frame.image for frame in frames], [frame.stamp_ns for frame in frames],
        [frame.jaw_opening_m for frame in frames],
    )  # fmt: skip
    first, last = (simulator.truth(i).cam_T_grip for i in (0, simulator.frame_count - 1))
    return shots, Truth(mounting, first, last, at_s if moves else None)


def make_lerobot(folder: Path, plan: list[tuple[int, bool]]) -> tuple[Path, list[Truth]]:
    """``folder/set`` and ``folder/wrist.yaml``, an episode for each (mounting, whether it moves): the configuration,
    and the truth of each.
    """
    path = folder / "lerobot.yaml"
    config = write_config(path, OF_LEROBOT)
    made = [episode(config, i, mounting, moves=moves, seed=0) for i, (mounting, moves) in enumerate(plan)]
    write_lerobot(folder / "set", [shots for shots, _ in made], fps=FPS, codec="libx264")
    return path, [truth for _, truth in made]


def make_bags(folder: Path, plan: list[tuple[int, bool]]) -> tuple[Path, list[Truth]]:
    """Likewise ``folder/bags`` with an MCAP file for each."""
    path = folder / "bags.yaml"
    config = write_config(path, OF_BAGS)
    (folder / "bags").mkdir()
    truths = []
    for i, (mounting, moves) in enumerate(plan):
        shots, truth = episode(config, i, mounting, moves=moves, seed=1)
        write_mcap(folder / "bags" / f"run{i}.mcap", shots)
        truths.append(truth)
    return path, truths
