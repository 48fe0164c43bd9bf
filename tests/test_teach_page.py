"""Teaching on the local web page, as a person does it in a real browser, on simulated images."""

from __future__ import annotations

import os
import signal
import socket
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
import yaml
from support.taught_by_hand import Rig, make_rig
from support.teach_page_browser import DEADLINE_S, Visitor, browser, page
from test_live_camera import MjpegServer

from gripmon.cli import main
from gripmon.daemon.config import load_config
from gripmon.model.geometry import from_record, perturbation_between

INNER = ("L_in_near", "L_in_far", "R_in_near", "R_in_far")
SNAPPED_PX = 0.2


_OVERLAPS = """
const names = document.querySelectorAll(".handle:not([visibility=hidden]) text");
const boxes = [...names].map((name) => name.getBoundingClientRect());
const over = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
  && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3;
return boxes.flatMap((a, k) => boxes.slice(k + 1).filter((b) => over(a, b)).map((b) => `${a.left} ${b.left}`));
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return make_rig(tmp_path_factory.mktemp("hand"))


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    opened = browser()
    yield opened
    opened.quit()


def truth_of(rig: Rig) -> np.ndarray:
    transform = rig.truth["cam_T_grip"]
    if isinstance(transform, dict):
        from gripmon.model.records import Transform

        return from_record(Transform(tuple(transform["translation_m"]), tuple(transform["rotation_xyzw"])))
    return np.reshape(transform, (4, 4))


def off_px(visitor: Visitor, rig: Rig, corner: str) -> float:
    return float(np.linalg.norm(np.array(visitor.at(corner)) - rig.corners_px[corner]))


def test_from_four_dragged_corners_to_a_configuration(rig: Rig, driver: Any, tmp_path: Path, capsys):
    from selenium.webdriver.common.keys import Keys

    with page(rig.image_path, *rig.options, "--out", tmp_path, "--robot", "arm7") as running:
        visitor = Visitor(driver, running.url)
        assert "Drag 3 corners" in visitor.text("#status")
        for width_px in (600, 900, 1400):
            driver.set_window_size(width_px, 900)
            visitor.settle()
            assert visitor.script(_OVERLAPS) == [], f"names of corners lie over each other at {width_px} px"
        assert not visitor.find("#expected").is_displayed()
        for name, (u, v) in rig.rough(*INNER, off_px=5.0).items():
            visitor.drag(name, u, v)
        assert [visitor.state(name) for name in INNER] == ["measured"] * 4, visitor.text("#status")
        assert max(off_px(visitor, rig, name) for name in (*INNER, "L_out_near", "R_out_near")) < SNAPPED_PX
        row = visitor.text("#corners tr[data-corner=L_in_near]").split()
        assert 0.0 < float(row[1]) < SNAPPED_PX and row[-1] == "%"
        assert "hidden by its own finger" in visitor.text("#corners tr[data-corner=L_out_far]")
        accuracy = visitor.text("#accuracy")
        assert "Forecast: a transform of this view is good to" in visitor.text("#promise")
        assert "one frame" in accuracy and "smallest drift" in accuracy and "reference" in accuracy

        visitor.keys("z", control=True)
        assert visitor.state("R_in_far") != "measured"
        visitor.keys("y", control=True)
        assert visitor.state("R_in_far") == "measured"

        visitor.click("#corners tr[data-corner=R_in_near]")
        u, v = visitor.at("R_in_near")
        visitor.keys(Keys.ARROW_RIGHT)
        visitor.keys(Keys.ARROW_UP, shift=True)
        moved_u, moved_v = visitor.at("R_in_near")
        assert (moved_u - u, moved_v - v) == pytest.approx((1.0, -0.1), abs=1e-3)
        assert visitor.state("R_in_near") == "hand" and "set by hand" in visitor.text("tr[data-corner=R_in_near]")
        visitor.keys("s")
        assert visitor.state("R_in_near") == "measured" and off_px(visitor, rig, "R_in_near") < SNAPPED_PX
        visitor.keys(Keys.TAB)
        assert "selected" in str(visitor.find("tr[data-corner=R_in_far]").get_attribute("class"))
        before = visitor.text("#zoom")
        visitor.keys("+", Keys.ENTER)
        assert visitor.text("#zoom") != before and off_px(visitor, rig, "R_in_far") < SNAPPED_PX

        visitor.click("#save")
        visitor.wait(lambda: "gripmon check" in visitor.text("#saved"), "the files")
        visitor.click("#save")
        visitor.wait(lambda: "is there already" in visitor.text("#saved"), "the question")
        assert visitor.text("#save") == "Replace what is there"
        stamp = (tmp_path / "config.yaml").stat().st_ino
        visitor.click("#save")
        visitor.wait(lambda: "gripmon check" in visitor.text("#saved"), "the files again")
        assert (tmp_path / "config.yaml").stat().st_ino != stamp
        assert visitor.complaints() == []
        visitor.click("#done")
        assert running.ended() == (0, "")

    config = load_config(tmp_path / "config.yaml")
    assert config.settings.robot == "arm7" and config.taught is not None
    assert len(config.taught.edges) >= 8 and config.taught.provenance.images[0].file == str(rig.image_path)
    # The pose is as good as it says.
    error = perturbation_between(config.cam_T_grip, truth_of(rig))
    covariance = np.reshape(config.reference.covariance, (6, 6))
    assert error @ np.linalg.solve(covariance, error) < 22.5  # 99.9 % of six degrees of freedom
    assert np.sqrt(covariance[0, 0]) < 1e-4 and np.sqrt(covariance[2, 2]) < 5e-4
    saved = yaml.safe_load((tmp_path / "corners.yaml").read_text())["corners"]
    assert set(saved) >= set(INNER)
    assert all(np.linalg.norm(np.array(at) - rig.corners_px[name]) < SNAPPED_PX for name, at in saved.items())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.yaml", "corners.yaml", "taught.yaml"]
    capsys.readouterr()
    assert main(["check", str(tmp_path / "config.yaml")]) == 0
    assert "sound" in capsys.readouterr().out


@pytest.mark.slow("a browser for each; from four corners to a configuration is in the default run")
def test_a_live_camera_and_two_pages(rig: Rig, driver: Any, tmp_path: Path):
    class Camera(MjpegServer):
        def stream(self, send: Any) -> None:
            jpeg = cv2.imencode(".jpg", rig.image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
            head = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
            while not self.stopping.wait(0.05):
                send(head + jpeg + b"\r\n")

    camera = Camera()
    opening_m = rig.truth["jaw_opening_m"]
    try:
        with page("--live", f"http://127.0.0.1:{camera.port}/", *rig.options, "--out", tmp_path) as running:
            first = Visitor(driver, running.url)
            first.script("document.querySelector('#opening').value = arguments[0]", 1e3 * opening_m)
            for name, (u, v) in rig.rough(*INNER).items():
                first.drag(name, u, v)
            assert max(off_px(first, rig, name) for name in INNER) < SNAPPED_PX, first.text("#status")
            first.click("#take")
            first.wait(lambda: "1 image taken" in first.text("#status"), "the image")
            tab = driver.current_window_handle
            driver.switch_to.new_window("tab")
            second = Visitor(driver, running.url)
            # The image is everybody's, the corners are one's own.
            assert second.script("return document.querySelectorAll('#picture option').length") == 2
            assert second.state("L_in_near") == "idle"
            assert second.complaints() == []
            driver.close()
            driver.switch_to.window(tab)
            assert first.state("L_in_near") == "measured"
            first.click("#save")
            first.wait(lambda: "gripmon check" in first.text("#saved"), "the files")
            assert first.complaints() == []
            driver.get("about:blank")  # or it would go on asking for live images
            running.process.send_signal(signal.SIGINT)
            assert running.ended() == (130, "gripmon: interrupted\n")
    finally:
        camera.stop()
    config = load_config(tmp_path / "config.yaml")
    assert config.settings.source.device == f"http://127.0.0.1:{camera.port}/"  # type: ignore[union-attr]
    assert config.jaw_opening_m == pytest.approx(opening_m)
    assert config.taught is not None
    assert Path(config.taught.provenance.images[0].file) == tmp_path / "teaching" / "live-000.png"
    assert (tmp_path / "teaching" / "live-000.png").is_file()


def test_an_interrupt_leaves_nothing_running(rig: Rig, tmp_path: Path):
    with page(rig.image_path, *rig.options, "--out", tmp_path) as running:
        port = urllib.parse.urlsplit(running.url).port
        process = psutil.Process(running.process.pid)
        assert {at.laddr.ip for at in process.net_connections() if at.status == psutil.CONN_LISTEN} == {"127.0.0.1"}
        family = process.children(recursive=True)
        # A client that says nothing and one in the middle of a request don't hold it up.
        silent = socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
        silent.sendall(b"POST / HTTP/1.1\r\nContent-Length: 100\r\n")
        os.kill(running.process.pid, signal.SIGINT)
        assert running.ended() == (130, "gripmon: interrupted\n")
        silent.close()
        assert not any(child.is_running() for child in family)
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
    assert list(tmp_path.iterdir()) == []
