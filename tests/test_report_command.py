"""``gripmon report`` on real recordings, whole and damaged, and its page in a real browser."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from support.configurations import shipped

from gripmon.analyse.content import Report
from gripmon.cli import main
from gripmon.daemon.config import load_config
from gripmon.io.sources import make_simulator
from gripmon.simulate import Simulator

ROOT = Path(__file__).parent.parent
SECONDS, FPS = 12.0, 20.0


@pytest.fixture(scope="module")
def collision(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Simulator]:
    """A recording of a monitor on the demo's camera, every frame of it, and the truth."""
    folder = tmp_path_factory.mktemp("collision")
    document: dict[str, Any] = yaml.safe_load(shipped())
    document["source"] |= {"realtime": False, "ends": True, "fps": FPS, "duration_s": SECONDS}
    document["publish"] = {"enabled": False}
    config = folder / "collision.yaml"
    config.write_text(yaml.safe_dump(document))
    command = [sys.executable, "-m", "gripmon", "run", str(config), "--out", str(folder / "out")]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True, timeout=180)
    loaded = load_config(config)
    (recording,) = (folder / "out").glob("*.rrd")
    return recording, make_simulator(loaded.settings.source, loaded.scene, loaded.directory)


@pytest.fixture(scope="module")
def reported(collision: tuple[Path, Simulator]) -> tuple[Path, Report]:
    """Its page and its data."""
    page = collision[0].parent / "report.html"
    assert main(["report", str(collision[0]), "--out", str(page), "--json", str(page.with_suffix(".json"))]) == 0
    return page, msgspec.json.decode(page.with_suffix(".json").read_bytes(), type=Report)


def test_what_is_said_of_a_collision_is_true(collision: tuple[Path, Simulator], reported: tuple[Path, Report]):
    simulator = collision[1]
    (recording,) = reported[1].recordings
    truths = [simulator.truth(i) for i in range(simulator.frame_count)]
    shifts_m = np.array([t.tcp_shift_m for t in truths])
    stamps_ns = np.array([t.stamp_ns for t in truths])
    knocked = int(np.argmax(np.linalg.norm(np.diff(shifts_m, axis=0), axis=1))) + 1
    creep, step = (e for e in recording.events if e.kind in ("creep", "drift", "step"))

    assert step.kind == "step"
    assert step.onset.earliest_ns <= stamps_ns[knocked] <= step.onset.latest_ns
    rest_m = shifts_m[-1] - shifts_m[knocked - 1]
    assert step.moved.size_m == pytest.approx(float(np.linalg.norm(rest_m)), abs=0.06e-3)
    assert step.moved.rotation_rad == pytest.approx(_turn(truths[knocked - 1], truths[-1]), abs=math.radians(0.2))
    assert step.cause == "camera_mount_moved"

    moved = np.linalg.norm(shifts_m, axis=1) > 0.0
    began_ns = int(stamps_ns[int(np.argmax(moved))])
    assert creep.onset.earliest_ns <= began_ns + 1e8
    assert abs(creep.onset.stamp_ns - began_ns) < 0.4e9
    assert creep.moved.size_m == pytest.approx(float(np.linalg.norm(shifts_m[knocked - 1])), abs=0.05e-3)

    assert recording.at_end.tcp_shift_m == pytest.approx(tuple(shifts_m[-1]), abs=0.06e-3)
    old = next(a for a in recording.affected if a.what == "old_calibration")
    beyond = stamps_ns[np.linalg.norm(shifts_m, axis=1) > recording.limits.affected_m]
    assert abs(old.limit_ns - int(beyond[0])) <= 0.3e9 and old.ended_by == "end_of_recording"
    stale = next(a for a in recording.affected if a.what == "stale_reference")
    assert stale.ended_by == "recalibration" and stale.end_ns == recording.references[1].in_force_ns
    assert recording.running.frames == simulator.frame_count and recording.running.frames_dropped == 0
    assert "recording's configuration" in recording.limits.origin
    assert any(e.kind in ("lost", "occluded") for e in recording.events)


def _turn(before: Any, after: Any) -> float:
    relative = after.cam_T_grip[:3, :3] @ before.cam_T_grip[:3, :3].T
    return math.acos(min(1.0, 0.5 * (float(np.trace(relative)) - 1.0)))


def test_pictures_stand_beside_the_events(reported: tuple[Path, Report]):
    import base64

    import cv2

    blobs = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', reported[0].read_text())
    assert len(blobs) >= 5
    for blob in blobs:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(blob), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[1] == 560
    seen = cv2.imdecode(np.frombuffer(base64.b64decode(blobs[0]), np.uint8), cv2.IMREAD_COLOR).astype(int)
    green = (seen[:, :, 1] - np.maximum(seen[:, :, 0], seen[:, :, 2])) > 60
    assert green.sum() > 200, "edge points that were used"


@pytest.fixture
def browser() -> Iterator[Any]:
    """A real one, without a window."""
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no chromium and chromedriver here")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1240,1800",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(options=options, service=Service(driver))
    opened.set_script_timeout(60)
    yield opened
    opened.quit()


def test_the_page_works_in_a_browser_without_a_network(reported: tuple[Path, Report], browser: Any):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.wait import WebDriverWait

    browser.get(reported[0].as_uri())
    wait = WebDriverWait(browser, 60)
    wait.until(lambda b: len(b.find_elements(By.CSS_SELECTOR, ".plot .main-svg")) >= 4)
    lines = browser.find_elements(By.CSS_SELECTOR, "#drift-1-figure .scatterlayer .trace .js-line")
    assert len(lines) >= 10, "curves, bands and strips"
    browser.find_element(By.CSS_SELECTOR, "[data-scale]").click()
    wait.until(
        lambda b: b.execute_script("return document.getElementById('drift-1-figure').layout.yaxis.type") == "log"
    )
    browser.find_element(By.CSS_SELECTOR, "[data-plot]").click()
    shown = "return document.getElementById('drift-1-figure').layout.xaxis.autorange"
    wait.until(lambda b: b.execute_script(shown) is False)
    # In other windows the plots are as high as before, not squeezed.
    heights = "return [...document.querySelectorAll('.plot')].map((plot) => plot._fullLayout.height)"
    widths, before = heights.replace("height", "width"), browser.execute_script(heights)
    for width_px in (900, 600):
        wide = browser.execute_script(widths)
        browser.set_window_size(width_px, 900)
        wait.until(lambda b, w=wide: all(now < then for now, then in zip(b.execute_script(widths), w, strict=True)))
    assert browser.execute_script(heights) == before
    # On a telephone nothing but tables is wider than the window.
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    beyond = (
        "return [...document.querySelectorAll('main *')].filter((e) => !e.closest('.scroll, svg, .js-plotly-plot')"
        " && e.getBoundingClientRect().right > 391).map((e) => e.outerHTML.slice(0, 80))"
    )
    wait.until(lambda b: b.execute_script("return window.innerWidth") == 390)
    wait.until(lambda b: max(b.execute_script(widths)) < 390)
    assert browser.execute_script(beyond) == []
    for button in browser.find_elements(By.CSS_SELECTOR, ".modebar-btn"):
        assert "cloud" not in (button.get_attribute("data-title") or "").lower()
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert asked, "the log of requests works: the page itself is in it"
    assert {url.split(":", 1)[0] for url in asked} <= {"file", "data", "blob"}
    assert [url for url in asked if url.startswith("file:")] == [reported[0].as_uri()]
    assert [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")] == []


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(["report", *arguments])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, said.out, said.err


def test_a_recording_cut_short_is_reported_as_far_as_it_goes(
    collision: tuple[Path, Simulator], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = collision[0].read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(data[: int(0.6 * len(data))])
    code, out, err = run(capsys, str(cut), "--out", str(tmp_path / "cut.html"), "--json", str(tmp_path / "cut.json"))
    assert code == 0 and "cut.rrd" in err
    report = json.loads((tmp_path / "cut.json").read_text())
    (recording,) = report["recordings"]
    assert 0 < recording["running"]["frames"] < 240 and recording["faults"]
    assert recording["summary"] in out
    assert "could not be used" in (tmp_path / "cut.html").read_text()


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("empty.rrd", b"", 3),
        ("noise.rrd", np.random.default_rng(1).bytes(5000), 3),
        ("notes.txt", b"no recording\n", 2),
        ("lines.jsonl", b"{}\nno json\n", 3),
    ],
)
def test_nothing_usable_is_one_line(
    name: str, content: bytes, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / name).write_bytes(content)
    for given in (tmp_path / name, *([tmp_path] if name.endswith(".rrd") else [])):
        got, out, err = run(capsys, str(given), "--out", str(tmp_path / "page.html"))
        assert got == code and out == "" and len(err.splitlines()) == 1 and name in err
    assert not (tmp_path / "page.html").exists()


def test_another_application_s_recording_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    import rerun as rr

    other = tmp_path / "other.rrd"
    with rr.RecordingStream("somebody_else") as stream:
        stream.save(other)
        stream.log("points", rr.Points2D([[1.0, 2.0]]))
    code, out, err = run(capsys, str(other), "--json", "-")
    assert code == 3 and out == "" and len(err.splitlines()) == 1 and "somebody_else" in err


def test_a_bad_file_beside_a_good_one_is_told(
    collision: tuple[Path, Simulator], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad = tmp_path / "bad.rrd"
    bad.write_bytes(b"RRF2" + bytes(100))
    code, out, err = run(capsys, str(bad), str(collision[0]), "--json", "-")
    assert code == 0 and "bad.rrd" in err
    report = json.loads(out)
    assert len(report["recordings"]) == 1 and "bad.rrd" in report["faults"][0]


def test_wrong_usage_is_one_line(collision: tuple[Path, Simulator], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for arguments, word in (
        ((str(tmp_path / "missing.rrd"),), "missing.rrd"),
        ((str(tmp_path),), "holds no .rrd file"),
        ((str(collision[0]), "--out", str(tmp_path)), "is a folder"),
    ):
        code, _, err = run(capsys, *arguments)
        assert code == 2 and word in err and len(err.splitlines()) == 1
    (tmp_path / "estimates.jsonl").touch()
    assert run(capsys, str(tmp_path))[2].endswith(f"{tmp_path / 'estimates.jsonl'} by its name\n")
