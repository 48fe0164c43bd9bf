"""Against the real package ``lerobot``: its record loop, its datasets, its pipelines.

Its requirements and gripmon's exclude each other (OpenCV, rerun), so that it lives in an environment of its own, whose
Python ``GRIPMON_LEROBOT_PYTHON`` names: see docs/howto/lerobot.md.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.episode_files import WRIST
from support.lerobot_process import FLAG, POSE
from support.loopback import free_endpoint
from support.network_daemon import network_config, network_daemon
from support.remote_monitor import remote_monitor
from test_dataset import hashes_of
from test_lerobot_example import EXAMPLE, FIRST, LAST, stretches, write_stretches

from gripmon.analyse.stretches import Stretch
from gripmon.cli import main
from gripmon.daemon.config import load_config

PYTHON = os.environ.get("GRIPMON_LEROBOT_PYTHON", "")
TESTS = Path(__file__).resolve().parent
pytestmark = pytest.mark.skipif(not PYTHON, reason="GRIPMON_LEROBOT_PYTHON names no Python with lerobot")
HERE = {"translation_m": [0.001, 0.002, 0.12], "rotation_xyzw": [0.0, 0.0, 0.6, 0.8]}
VALID = {
    "verdict": "valid", "cam_T_grip": HERE, "reason": None,
    "protection": {"position_m": 4e-4, "rotation_rad": 5e-3, "risk": 1e-5},
}  # fmt: skip


def in_lerobot(command: str, **asked: object) -> dict:
    environment = os.environ | {"PYTHONPATH": f"{TESTS.parent}:{TESTS}", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        [PYTHON, str(TESTS / "support" / "lerobot_process.py"), command, json.dumps(asked)],
        capture_output=True, text=True, env=environment, timeout=180, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A dataset that LeRobot recorded beside a monitor."""
    root, endpoint = tmp_path_factory.mktemp("recorded") / "set", free_endpoint()
    with remote_monitor(listen=[endpoint], answer=VALID):
        step = {"robot": "arm", "camera": "wrist", "connect": [endpoint]}
        return root, in_lerobot("record", root=str(root), step=step, seconds=1.0)


def test_recorded_observations_have_the_extrinsics(recorded: tuple[Path, dict]):
    _, found = recorded
    assert len(found["flag"]) >= 5 and set(found["flag"]) == {1.0}
    np.testing.assert_allclose(found["pose"], [[*HERE["translation_m"], *HERE["rotation_xyzw"]]] * len(found["flag"]))
    assert found["shapes"] == {POSE: [7], FLAG: []}
    assert found["state"]["names"] == ["gripper.pos"], "what policies learn from is as it was"


def test_flag_is_not_set_for_what_is_not_valid(tmp_path: Path):
    endpoint = free_endpoint()
    with remote_monitor(listen=[endpoint], answer=VALID | {"verdict": "suspect", "reason": "held"}):
        step = {"robot": "arm", "camera": "wrist", "connect": [endpoint]}
        found = in_lerobot("record", root=str(tmp_path / "set"), step=step, seconds=0.5)
    assert set(found["flag"]) == {0.0}
    np.testing.assert_allclose(found["pose"][0][:3], HERE["translation_m"], rtol=1e-6)


@pytest.mark.parametrize(
    ("moved_m", "mm", "words"),
    [
        (0.0009, 1.0, None),
        (0.003, 1.0, r"moved since training by 3\.00 mm and 0\.00°, known within 0\.40 mm; at most 1\.00 mm"),
    ],
)
def test_evaluation_whose_camera_moved_is_refused(recorded, moved_m: float, mm: float, words: str | None):
    """What is not known is refused, too: test_trained.py."""
    root, _ = recorded
    place = [HERE["translation_m"][0] + moved_m, *HERE["translation_m"][1:]]
    endpoint = free_endpoint()
    with remote_monitor(listen=[endpoint], answer=VALID | {"cam_T_grip": HERE | {"translation_m": place}}):
        step = {"robot": "arm", "camera": "wrist", "connect": [endpoint]}
        found = in_lerobot("evaluate", root=str(root), step=step, mm=mm, deg=1.0)
    if words is None:
        assert found["shift_m"] == pytest.approx(moved_m, abs=1e-7) and found["turn_rad"] < 1e-6
    else:
        assert re.search(words, found["refused"]), found


def test_datasets_of_lerobot_get_columns_that_it_reads(tmp_path: Path):
    original, copy = tmp_path / "set", tmp_path / "copy"
    in_lerobot("make", root=str(original))
    hashes = hashes_of(original)
    rows = [*stretches("#000000"), Stretch(episode="#000001", camera=WRIST, reason="too dark")]
    write_stretches(tmp_path / "stretches", rows)
    command = [PYTHON, str(EXAMPLE), str(original), str(tmp_path / "stretches"), str(copy)]
    environment = os.environ | {"PYTHONPATH": str(TESTS.parent), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=180, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert hashes_of(original) == hashes, "originals are never touched"
    found = in_lerobot("shown", root=str(copy))
    assert found["flag"] == [1, 0, 1, 0, 1, 1] + [0] * 6 and found["episode"] == [0] * 6 + [1] * 6
    np.testing.assert_allclose(found["pose"][:6], [FIRST] * 3 + [LAST] * 3, atol=1e-7)
    step = {"robot": "arm", "camera": "wrist", "connect": [free_endpoint()]}
    refused = in_lerobot("evaluate", root=str(original), step=step, mm=1.0, deg=1.0)["refused"]
    assert "has no column observation.extrinsics.wrist" in refused


def test_pipeline_that_was_saved_is_the_same(tmp_path: Path):
    opening = {"joint": "gripper.pos", "scale_m": 0.08, "offset_m": 0.0}
    step = {"robot": "arm", "camera": "wrist", "connect": [free_endpoint()], "feed": True, "opening": opening}
    found = in_lerobot("saved", root=str(tmp_path), step=step)
    assert found["before"] == found["after"] and found["after"]["opening"] == opening


def test_images_that_lerobot_has_are_measured(tmp_path: Path):
    """``gripmon run`` gets the images from LeRobot's loop, and each frame has the transform of its own image."""
    folder, endpoint = tmp_path / "images", free_endpoint()
    assert main(["simulate", "static", "--seconds", "2", "--fps", "10", "--seed", "1", "--out", str(folder)]) == 0
    config = network_config(folder, f"{{listen: [{endpoint}]}}")
    opening = {"joint": "gripper.pos", "scale_m": 0.08}
    step = {"robot": "simulated", "camera": "wrist", "connect": [endpoint], "feed": True, "wait_s": 1.0}
    with network_daemon(config, tmp_path / "run"):
        asked = {"step": step | {"opening": opening}, "images": str(folder), "seconds": 6.0}
        found = in_lerobot("record", root=str(tmp_path / "set"), **asked)
    truth = load_config(folder / "config.yaml", check_source=False).reference.cam_T_grip
    usable = np.array(found["pose"])[np.array(found["flag"]) == 1.0]
    assert len(usable) >= 5 and len(usable) >= 0.5 * len(found["flag"])
    assert np.linalg.norm(usable[:, :3] - np.array(truth.translation_m), axis=1).max() < 1e-3
