"""The whole way of a new user, by the commands that the README names: a camera and a gripper of which no one has a file
become a monitor that notices a knock.  Commands and pages write every file: the tests write none.  Truth comes from
the simulator.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import new_user
from support.loopback import wait_for_default_port
from support.teach_page_browser import DEADLINE_S, ROOT, Visitor, browser, page

from gripmon.cli import main
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import Transform

CHI2_999 = 22.5
"""Of six degrees of freedom."""
STEP = new_user.STEP


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> new_user.NewUser:
    return new_user.make(tmp_path_factory.mktemp("new"))


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    """None on a machine without a browser, where only what needs one is skipped."""
    try:
        opened = browser()
    except pytest.skip.Exception:
        yield None
    else:
        yield opened
        opened.quit()


@pytest.fixture(scope="module")
def calibrated(user: new_user.NewUser, driver: Any) -> Path:
    """camera.yaml, rough.yaml, gripper.yaml and hand_eye.yaml, by the off-line methods and the page between."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(user.folder)
        assert gripmon(f"calibrate intrinsics plate --target {new_user.TARGET} --model paper --out camera.yaml") == 0
        _rough_corners(user, driver)
        standing = "calibrate plane standing --target camera.yaml --camera camera.yaml --corners rough.yaml"
        assert gripmon(f"{standing} --infer --jaw-range 0:0.06 --gripper-out gripper.yaml --out hand_eye.yaml") == 0
    return user.folder


def _rough_corners(user: new_user.NewUser, driver: Any) -> None:
    """Put on the page, some pixels off, with the mouse; without a browser its save request is sent by itself."""
    clicks = {name: at.tolist() for name, at in user.rough_px(np.random.default_rng(4), off_px=4.0).items()}
    with page("standing/0.png", "--camera", "camera.yaml") as running:
        if driver is None:
            order = {"put": {"corners": clicks}, "robot": "robot", "camera_name": "camera"}
            body, kind = json.dumps(order).encode(), {"Content-Type": "application/json"}
            urllib.request.urlopen(urllib.request.Request(f"{running.url}save", body, kind), timeout=DEADLINE_S).close()
            return
        visitor = Visitor(driver, running.url)
        visitor.put(clicks)
        visitor.click("#save")
        visitor.wait(lambda: "gripmon calibrate plane standing/0.png" in visitor.text("#saved"), "the next command")
        assert visitor.complaints() == []
        visitor.click("#done")
        assert running.ended() == (0, "")


def gripmon(words: str) -> int:
    return main(words.split())


def test_taught_without_a_page_the_running_monitor_notices_a_knock(
    user: new_user.NewUser, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    first, rough = calibrated / "work" / "000000.png", calibrated / "rough.yaml"  # of the first page
    options = [str(word) for word in _given(calibrated)]
    assert main(["teach", str(first), "--corners", str(rough), *options, "--out", str(tmp_path)]) == 0
    _checked(tmp_path / "config.yaml", capsys)
    records = _replayed(calibrated, tmp_path)
    _held_against_the_truth(user, records)
    wait_for_default_port()
    ran = subprocess.run(
        [sys.executable, "-m", "gripmon", "run", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "run")],
        capture_output=True, text=True, timeout=4 * DEADLINE_S, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert "step raised" in ran.stderr and "the camera moved against the gripper" in ran.stderr
    # The daemon decides what the replay decides, frame by frame.
    live = _lines(tmp_path / "run" / "estimates.jsonl")
    assert [_decided(r) for r in live] == [_decided(r) for r in records]
    capsys.readouterr()
    page, data = str(tmp_path / "report.html"), tmp_path / "report.json"
    assert main(["report", str(tmp_path / "run"), "--out", page, "--json", str(data)]) == 0
    assert "moved once" in capsys.readouterr().out and (tmp_path / "report.html").exists()
    _placed_at_the_knock(json.loads(data.read_text())["recordings"][0], live)
    estimates = str(tmp_path / "run" / "estimates.jsonl")
    assert main(["calibrate", "verify", str(calibrated / "hand_eye.yaml"), estimates]) == 3
    assert "different" in capsys.readouterr().out


def _placed_at_the_knock(reported: dict[str, Any], live: list[dict[str, Any]]) -> None:
    """Whatever the monitor called it at the time, and though it noticed it later."""
    (moved,) = [event for event in reported["events"] if event["moved"] is not None]
    off_s = 1e-9 * (moved["onset"]["stamp_ns"] - live[STEP]["stamp_ns"])
    assert abs(off_s) < 2.5 / new_user.FPS and moved["kind"] == "step"
    old = [each for each in reported["affected"] if each["what"] == "old_calibration"]
    assert sum(each["end_ns"] - each["start_ns"] for each in old) <= reported["end_ns"] - moved["onset"]["earliest_ns"]


def _given(calibrated: Path) -> list[object]:
    out: list[object] = []
    for option, name in (("camera", "camera"), ("gripper", "gripper"), ("reference", "hand_eye")):
        out += [f"--{option}", calibrated / f"{name}.yaml"]
    return out


def _checked(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["check", str(config), "--verbose"]) == 0
    said = capsys.readouterr().out
    assert "sound" in said and "smallest step that is noticed" in said and "weakest" in said


def _replayed(calibrated: Path, folder: Path) -> list[dict[str, Any]]:
    out = folder / "replay.jsonl"
    config = str(folder / "config.yaml")
    assert main(["replay", str(calibrated / "work"), "--config", config, "--out", str(out)]) == 0
    return _lines(out)


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _decided(record: dict[str, Any]) -> dict[str, Any]:
    """What a frame's record says, without how long it took and where the frame came from."""
    return {key: value for key, value in record.items() if key not in ("latency_ns", "name")}


def _held_against_the_truth(user: new_user.NewUser, records: list[dict[str, Any]]) -> None:
    """No alert before the knock, one after it with the right size; the TCP within what is stated, before and after."""
    assert len(records) == len(user.cam_T_grip)
    raised = [k for k, record in enumerate(records) if any(a["kind"] == "step" for a in record["alerts"])]
    assert raised and STEP <= raised[0] <= STEP + 25, raised
    assert records[STEP - 1]["state"] == "tracking" and records[-1]["state"] == "drifting"
    errors, sizes = [], []
    for record, true in zip(records, user.cam_T_grip, strict=True):
        error = perturbation_between(_pose(record["cam_T_grip"]), true)
        errors.append(error)
        sizes.append(error @ np.linalg.solve(np.reshape(record["covariance"], (6, 6)), error))
    across = np.linalg.norm(np.array(errors)[:, :2], axis=1)
    settled = slice(-30, None)
    assert np.median(across[:STEP]) < 3e-5 and np.median(across[settled]) < 3e-5
    assert np.median(sizes[:STEP]) < CHI2_999 and np.median(sizes[settled]) < CHI2_999
    shift = np.median([record["drift"]["tcp_shift_m"] for record in records[settled]], axis=0)
    true_shift = user.cam_T_grip[-1][:3, 3] - user.cam_T_grip[0][:3, 3]
    assert abs(true_shift[1]) > 8e-4
    np.testing.assert_allclose(shift[:2], true_shift[:2], atol=3e-5)


def _pose(value: dict[str, Any]) -> np.ndarray:
    return from_record(Transform(tuple(value["translation_m"]), tuple(value["rotation_xyzw"])))
