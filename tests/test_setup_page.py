"""``gripmon setup`` in a real browser, from nothing to a running monitor on simulated images, and what goes wrong."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from support import new_user
from support.loopback import wait_for_default_port
from support.other_grippers import STEP, curved_meshes, rounded_tips
from support.setup_walk import Walker, walk, walk_with_a_model
from support.simulated import BOX_FINGERS
from support.teach_page_browser import browser, page

from gripmon.daemon.config import load_config
from gripmon.model.geometry import from_record, invert, perturbation_between
from gripmon.model.records import Array, FrameRecord, Verdict


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> new_user.NewUser:
    return new_user.make(tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    opened = browser()
    yield opened
    opened.quit()


Walked = tuple[Path, dict[str, Any]]
STANDS_OUT = "return [...document.querySelectorAll('#buttons .main')].map((b) => b.textContent)"


def gone(folder: Path, driver: Any, go: Callable[[Walker, Callable[[str], object]], None]) -> Walked:
    """Someone goes a whole way; the page after each step."""
    wait_for_default_port()
    seen: dict[str, Any] = {}
    with page(folder, command=("setup",)) as running:
        visitor = Walker(driver, running.url)

        def at(step: str) -> None:
            seen[step] = {"ugly": visitor.ugly(), "status": visitor.text("#status"), "said": visitor.text("#said")}
            seen[step] |= {"command": visitor.text("#command code"), "log": visitor.text("#log")}

        go(visitor, at)
        assert visitor.complaints() == []
        visitor.click("#done")
        assert running.ended() == (0, "")
    return folder, seen


@pytest.fixture(scope="module")
def walked(user: new_user.NewUser, driver: Any, tmp_path_factory: pytest.TempPathFactory) -> Walked:
    """The project of a person who went the whole way."""
    folder = tmp_path_factory.mktemp("way") / "arm1"
    return gone(folder, driver, lambda visitor, at: walk(visitor, user, at))


def test_from_nothing_to_a_running_monitor(user: new_user.NewUser, walked: Walked):
    folder, seen = walked
    assert "768 x 576 px" in seen["camera"]["said"]
    assert (folder / "target.pdf").read_bytes().startswith(b"%PDF")
    config = load_config(folder / "config.yaml")
    assert config.settings.robot == "arm1" and config.taught is not None
    error = perturbation_between(config.cam_T_grip, user.cam_T_grip[0])
    assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all()  # as the commands by hand give it (test_first_run.py)
    assert "OKsource" in seen["check"]["said"] and "FAIL" not in seen["check"]["said"]
    assert "transform" in seen["running"]["status"]
    assert "a step: at " in seen["run"]["log"] and "stopped after 90 frames" in seen["run"]["log"]
    lines = [json.loads(line) for line in (folder / "run" / "estimates.jsonl").read_text().splitlines()]
    assert len(lines) == 90 and sum(line["verdict"] == "valid" for line in lines[: new_user.STEP]) > 0.9 * new_user.STEP
    commands = {step: each["command"] for step, each in seen.items()}
    assert commands["intrinsics"].startswith("gripmon calibrate intrinsics plate --target circles:12x10:0.008:0.004")
    assert "--infer" in commands["reference"] and commands["run"] == "gripmon run config.yaml --out run"


def held_against(truth: Array, folder: Path) -> tuple[float, float]:
    """Share of ``valid`` frames before the knock and after it, none of which misleads: none is farther from the true
    motion (frames, 4, 4) than it promises.
    """
    reference = load_config(folder / "config.yaml").cam_T_grip
    true_T_made = invert(truth[0]) @ reference
    lines = (folder / "run" / "estimates.jsonl").read_bytes().splitlines()
    records = [msgspec.json.decode(line, type=FrameRecord) for line in lines]
    assert len(records) == len(truth)
    valid = []
    for record, true in zip(records, truth, strict=True):
        valid.append(record.verdict is Verdict.VALID)
        if valid[-1]:
            assert record.cam_T_grip is not None and record.protection is not None
            error = perturbation_between(true @ true_T_made, from_record(record.cam_T_grip))
            assert np.linalg.norm(error[:3]) < record.protection.position_m
    return float(np.mean(valid[:STEP])), float(np.mean(valid[STEP:]))


@pytest.mark.usefixtures("tools_importable")
@pytest.mark.slow("some 60 s; the box's walk guards the page, test_gripper_from_images.py the model")
def test_the_same_with_rounded_tips_from_images(walked: Walked, driver: Any, tmp_path: Path):
    truth = rounded_tips(tmp_path)
    answers = {"gripper": "from images", "free_images": str(tmp_path / "free"), "distance": "0.115:0.00005"}
    camera = walked[0] / "camera.yaml"
    folder, seen = gone(
        tmp_path / "arm1",
        driver,
        lambda visitor, at: walk_with_a_model(visitor, tmp_path / "work", camera, answers, {}, at),
    )
    assert {step: each["ugly"] for step, each in seen.items() if each["ugly"]} == {}
    assert "the reference comes with it" in seen["gripper"]["said"]
    assert seen["gripper"]["command"].startswith("gripmon gripper from-images")
    assert "of 0 corners" not in seen["teach"]["status"] and "of the edges are inliers" in seen["teach"]["status"]
    assert "FAIL" not in seen["check"]["said"] and " the TCP was " in seen["run"]["log"]
    before, after = held_against(truth, folder)
    assert before > 0.5 and after > 0.0


@pytest.mark.usefixtures("tools_importable")
@pytest.mark.slow("some 60 s; the box's walk guards the page, test_gripper_cad_tracked.py the model")
def test_the_same_with_a_gripper_from_cad_and_the_robots_own_calibration(walked: Walked, driver: Any, tmp_path: Path):
    truth = curved_meshes(tmp_path)
    meshes = f"{tmp_path / 'finger0.stl'} {tmp_path / 'finger1.stl'}"
    gripper = {
        "gripper": "from CAD", "cad_files": meshes, "cad_unit": "mm", "cad_view": "0.115:32", "jaw_range": "0:0.06",
        "options": "--length 0.035 --bevel 0",
    }  # fmt: skip
    reference = {"reference_by": "a file", "reference_file": str(tmp_path / "robot.yaml")}
    # Curved outlines aren't taught; the page says so, and saves without.  These meshes' edges are as sharp as drawn.
    folder, seen = gone(
        tmp_path / "arm1",
        driver,
        lambda visitor, at: walk_with_a_model(
            visitor, tmp_path / "work", walked[0] / "camera.yaml", gripper, reference, at, opening_mm="30", taught=False
        ),
    )
    assert {step: each["ugly"] for step, each in seen.items() if each["ugly"]} == {}
    assert "TCP at 0.4, 1.3, 115.0 mm" in seen["reference"]["said"]
    assert "FAIL" not in seen["check"]["said"] and "stopped after 60 frames" in seen["run"]["log"]
    before, after = held_against(truth, folder)
    assert before > 0.9 and after > 0.5


def test_nothing_overflows_or_overlaps_at_any_width(walked: Walked):
    assert {step: each["ugly"] for step, each in walked[1].items() if each["ugly"]} == {}


def test_it_goes_on_where_it_stopped(walked: Walked, driver: Any, tmp_path: Path):
    folder = tmp_path / "again"
    shutil.copytree(walked[0], folder, copy_function=shutil.copy2)
    with page(folder, command=("setup",)) as running:
        visitor = Walker(driver, running.url)
        steps = visitor.script("return [...document.querySelectorAll('[data-step]')].map((b) => b.dataset.step)")
        assert {step: visitor.progress(step) for step in steps} == dict.fromkeys(steps, "done")
        (folder / "camera.yaml").touch()
        visitor.wait(lambda: visitor.progress("reference") == "stale", "what the lens was for is old")
        assert visitor.progress("intrinsics") == "done" and visitor.progress("plate") == "done"
        visitor.go("target")
        visitor.fill(target="circles:12x10:0.009:0.004")
        visitor.press("step")
        visitor.wait(lambda: visitor.progress("intrinsics") == "stale", "another target")
        visitor.click("#done")
        assert running.ended() == (0, "")
    kept = yaml.safe_load((folder / "setup.yaml").read_text())["values"]
    assert kept["target"] == "circles:12x10:0.009:0.004" and kept["robot"] == "arm1"


def test_bad_input_is_one_line_and_nothing_is_lost(user: new_user.NewUser, driver: Any, tmp_path: Path):
    folder = tmp_path / "bad"
    empty = tmp_path / "empty"
    empty.mkdir()
    with page(folder, command=("setup",)) as running:
        visitor = Walker(driver, running.url)
        for source, words in (
            ("", "no camera is named"),
            ("nowhere", "there is no such folder"),
            (str(empty), "no image in"),
            ("zenoh:1280", "names no camera"),
        ):
            visitor.fill(source=source)
            visitor.press("step")
            visitor.refused(words)
        visitor.fill(source=str(user.folder / "work"), robot="arm/1")
        visitor.press("step")
        visitor.refused("robot name", "can't be part")
        assert visitor.script("return document.querySelector('[name=source]').value") == str(user.folder / "work")
        visitor.fill(robot="arm1")
        visitor.press("step")
        visitor.done("camera")
        visitor.go("target")
        for values, words in (
            ({"target": "squares:3x3:1"}, "is not a target"),
            ({"target": "chequerboard:9x6:25"}, "millimetres?"),
            ({"target": "circles:12x10:0.008:0.004", "paper": "a9"}, "isn't a paper size"),
            ({"paper": "50x60"}, "too small"),
            ({"paper": "a4", "bar_measured": "15"}, "near the 150 mm"),
        ):
            visitor.fill(**values)
            visitor.press("step")
            visitor.refused(words)
        visitor.fill(bar_measured="148.5")
        visitor.press("step")
        visitor.done("target")
        assert "circles:12x10:0.00792:0.00396" in visitor.text("#said")  # a hundredth smaller, as the ruler says
        visitor.go("intrinsics")
        visitor.press("step")
        visitor.refused("first: Images of the target")
        visitor.go("plate")
        visitor.fill(plate_source=str(empty))
        visitor.press("step")
        visitor.refused("no image in")
        visitor.fill(plate_source=str(user.folder / "work"))
        visitor.press("step")
        visitor.press("take")
        visitor.refused("not taken: ")
        visitor.go("gripper")
        visitor.fill(gripper="a file", gripper_file=str(folder / "setup.yaml"))
        visitor.press("step")
        visitor.refused("setup.yaml", "the entries of gripmon setup; a gripper file")
        visitor.fill(gripper="two_box_fingers")
        visitor.press("step")
        visitor.done("gripper")
        assert (folder / "gripper.yaml").read_bytes() == Path(BOX_FINGERS).read_bytes()
        visitor.go("run")
        visitor.press("step")
        visitor.refused("config.yaml")
        others = [line for line in visitor.complaints() if "with a status of 4" not in line]
        assert others == [], "the browser notes each refusal, and a picture that was gone before it came"
        visitor.click("#done")
        assert running.ended() == (0, "")


def test_the_next_thing_to_do_stands_out_and_the_keyboard_reaches_it(walked: Walked, driver: Any, tmp_path: Path):
    folder = tmp_path / "keys"
    folder.mkdir()
    for name in ("camera.yaml", "setup.yaml"):
        shutil.copy2(walked[0] / name, folder / name)
    has_focus = "return document.activeElement.id || document.activeElement.name"
    with page(folder, command=("setup",)) as running:
        visitor = Walker(driver, running.url)
        visitor.go("reference")
        assert visitor.script(STANDS_OUT) == ["First: Gripper on the target →"]
        visitor.press("first")
        visitor.wait(lambda: visitor.text("#title") == "Gripper on the target", "the step")
        assert visitor.script(has_focus) == "title" and "press “Start”" in visitor.text("#status")
        # A choice that draws the fields anew, and a step that draws its buttons anew, keep the focus.
        visitor.script("document.querySelector('[name=reference_by]').focus()")
        visitor.fill(reference_by="a file")
        assert visitor.script(has_focus) == "reference_by"
        assert visitor.script(STANDS_OUT) == ["Use it"]
        visitor.go("camera")
        assert visitor.script(STANDS_OUT) == ["Next: Target →"]
        visitor.script("document.querySelector('#do-step').focus()")
        visitor.keys("\ue007")
        visitor.wait(lambda: "768 x 576 px" in visitor.text("#said"), "the camera")
        visitor.wait(lambda: visitor.script(has_focus) == "do-step", "the focus again")
        # What it looked at, anew each time: the address differs.
        shown = "const i = document.querySelector('#result img'); return i.naturalWidth > 0 && i.getAttribute('src')"
        visitor.wait(lambda: visitor.script(shown), "the picture")
        first = visitor.script(shown)
        visitor.press("step")
        visitor.wait(lambda: visitor.script(shown) not in (False, first), "another picture")
        # A button that stays as it is stays the same node: a click on it isn't lost between two answers.
        visitor.script("window.node = document.querySelector('[data-step=target]')")
        visitor.script("return new Promise((done) => setTimeout(done, 1300))")
        assert visitor.script("return window.node.isConnected")
        spoken = visitor.script("return window.node.getAttribute('aria-label')")
        assert spoken == "2. Target, done"
        visitor.click("#done")
        assert running.ended() == (0, "")
