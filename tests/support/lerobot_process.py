"""What runs in an environment with the real package ``lerobot``, beside which gripmon's own dependencies can't be:
COMMAND and one argument, JSON; the answer is the last line of stdout, JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

os.environ["HF_HUB_OFFLINE"] = "1"
SIZE_PX, FPS = (64, 48), 10
POSE, FLAG = "observation.extrinsics.wrist", "observation.extrinsics_valid.wrist"


class Arm:
    """As LeRobot's record loop sees a robot: a joint, and a camera whose images are those of a folder, or noise."""

    name = robot_type = "arm"

    def __init__(self, images: str | None = None) -> None:
        self._images = [np.random.default_rng(0).integers(0, 255, (SIZE_PX[1], SIZE_PX[0], 3), np.uint8)]
        self._openings_m = [0.03]
        if images is not None:
            import cv2

            lines = (Path(images) / "timestamps.csv").read_text().splitlines()
            rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
            grey = [cv2.imread(str(Path(images) / row["file"]), cv2.IMREAD_GRAYSCALE) for row in rows]
            self._images = [np.repeat(image[..., None], 3, axis=2) for image in grey]
            self._openings_m = [float(row["jaw_opening_m"]) for row in rows]
        self._count, self.action_features = 0, {"gripper.pos": float}
        self.observation_features = {"gripper.pos": float, "wrist": self._images[0].shape}

    def get_observation(self) -> dict:
        i, self._count = self._count % len(self._images), self._count + 1
        return {"gripper.pos": self._openings_m[i] / 0.08, "wrist": self._images[i]}

    def send_action(self, action: dict) -> dict:
        return action


def step_of(asked: dict):
    from gripmon.client.lerobot import ExtrinsicsStep

    return ExtrinsicsStep(**asked["step"])


def record(asked: dict) -> dict:
    """LeRobot's own loop with the step in its pipeline, teleoperated; an episode of ``frames``."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.datasets.pipeline_features import aggregate_pipeline_dataset_features, create_initial_features
    from lerobot.datasets.utils import combine_feature_dicts
    from lerobot.processor import RobotProcessorPipeline, make_default_processors
    from lerobot.processor.converters import observation_to_transition, transition_to_observation
    from lerobot.scripts.lerobot_record import record_loop
    from lerobot.teleoperators.teleoperator import Teleoperator

    class Hand(Teleoperator):
        name = "hand"
        config_class = action_features = feedback_features = is_connected = is_calibrated = None
        connect = calibrate = configure = send_feedback = disconnect = lambda *_: None

        def __init__(self) -> None: ...
        def __del__(self) -> None: ...
        def get_action(self) -> dict:
            return {"gripper.pos": 0.5}

    robot, step = Arm(asked.get("images")), step_of(asked)
    wait_for_the_first(step, robot)
    teleop_action, robot_action, _ = make_default_processors()
    observation = RobotProcessorPipeline(
        steps=[step], to_transition=observation_to_transition, to_output=transition_to_observation
    )
    features = combine_feature_dicts(
        aggregate_pipeline_dataset_features(teleop_action, create_initial_features(action=robot.action_features)),
        aggregate_pipeline_dataset_features(
            observation, create_initial_features(observation=robot.observation_features), use_videos=False
        ),
        {"observation.images.wrist": {
            "dtype": "image", "shape": robot.observation_features["wrist"], "names": ["height", "width", "channels"],
        }},
        step.dataset_features,
    )  # fmt: skip
    dataset = LeRobotDataset.create("me/arm", FPS, features, root=asked["root"], robot_type="arm", use_videos=False)
    events = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    record_loop(
        robot, events, FPS, teleop_action, robot_action, observation, dataset=dataset, teleop=Hand(),
        control_time_s=asked["seconds"], single_task="hold",
    )  # fmt: skip
    dataset.save_episode()
    dataset.finalize()
    step.close()
    return shown(asked)


def wait_for_the_first(step, robot) -> None:
    end_s = time.monotonic() + 60.0
    while step.read(robot.get_observation()).transform is None and time.monotonic() < end_s:
        time.sleep(0.05)


def shown(asked: dict) -> dict:
    """A dataset as LeRobot opens it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("me/arm", root=asked["root"])
    table = dataset.hf_dataset.with_format("numpy").select_columns([POSE, FLAG, "episode_index"])[:]
    item = dataset[0]
    return {
        "pose": np.stack(table[POSE]).tolist(), "flag": np.asarray(table[FLAG]).reshape(-1).tolist(),
        "episode": np.asarray(table["episode_index"]).tolist(), "state": dataset.meta.features["observation.state"],
        "shapes": {key: list(item[key].shape) for key in (POSE, FLAG)},
    }  # fmt: skip


def make(asked: dict) -> dict:
    """A dataset without extrinsics: two episodes of six frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        "observation.images.wrist": {
            "dtype": "image", "shape": (SIZE_PX[1], SIZE_PX[0], 3), "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["elbow", "gripper"]},
        "action": {"dtype": "float32", "shape": (1,), "names": ["gripper"]},
    }  # fmt: skip
    dataset = LeRobotDataset.create("me/arm", FPS, features, root=asked["root"], robot_type="arm", use_videos=False)
    for _ in range(2):
        for _ in range(6):
            image = np.full((SIZE_PX[1], SIZE_PX[0], 3), 90, np.uint8)
            state = np.array([0.3, 0.4], np.float32)
            action = np.zeros(1, np.float32)
            dataset.add_frame(
                {"observation.images.wrist": image, "observation.state": state, "action": action, "task": "hold"}
            )
        dataset.save_episode()
    dataset.finalize()
    return {}


def evaluate(asked: dict) -> dict:
    """What an evaluation does first: the shift since training, or why it is refused; the robot isn't moved."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from gripmon.client.lerobot import CameraMoved, trained_poses

    robot, step = Arm(asked.get("images")), step_of(asked)
    try:
        trained = trained_poses(LeRobotDataset("me/arm", root=asked["root"]))
        found = step.require_same_camera(robot, trained, limit_mm=asked["mm"], limit_deg=asked["deg"], wait_s=5.0)
        return {"shift_m": found.shift_m, "turn_rad": found.turn_rad}
    except (CameraMoved, ValueError) as error:
        return {"refused": str(error)}
    finally:
        step.close()


def saved(asked: dict) -> dict:
    """A pipeline that was kept as JSON and read again, as LeRobot does with a policy's."""
    from lerobot.processor import RobotProcessorPipeline
    from lerobot.processor.converters import observation_to_transition, transition_to_observation

    how = {"to_transition": observation_to_transition, "to_output": transition_to_observation}
    step = step_of(asked)
    RobotProcessorPipeline(steps=[step], name="observation", **how).save_pretrained(asked["root"])
    again = RobotProcessorPipeline.from_pretrained(asked["root"], config_filename="observation.json", **how)
    for one in (step, *again.steps):
        one.close()
    return {"before": step.get_config(), "after": again.steps[0].get_config()}


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        answer = {each.__name__: each for each in (record, shown, make, evaluate, saved)}[sys.argv[1]](
            json.loads(sys.argv[2])
        )
    print(json.dumps(answer), flush=True)
