"""docs/howto/network_camera.md: what it tells a driver to send is understood."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from support.loopback import WAIT_S, free_endpoint, wait_until

from gripmon.daemon.config import builtin_config, load_config
from gripmon.io.sources import NetworkCamera, NetworkSettings
from gripmon.io.sources.payload import raw_image
from gripmon.io.wire import DEFAULT_ENDPOINT, Link, PublishSettings
from gripmon.model.pixels import ENCODINGS
from gripmon.model.records import Frame, FrameNote, from_json

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"
PAGE = (ROOT / "docs" / "howto" / "network_camera.md").read_text()


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_driver_in_python_is_heard():
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,)))
    camera = NetworkCamera(NetworkSettings(), link, "gripmon/arm1/wrist/image", (1280, 720))
    code = block("python").replace(DEFAULT_ENDPOINT, endpoint)
    assert endpoint in code
    driver = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE)
    frames: list[Frame] = []
    try:
        wait_until(lambda: _read(camera, frames) or len(frames) >= 3 or driver.poll() is not None, "frames", WAIT_S)
        assert len(frames) >= 3, driver.communicate()
        assert all(frame.image is not None and frame.image.shape == (720, 1280) for frame in frames)
        assert frames[0].stamp_ns < frames[1].stamp_ns < frames[2].stamp_ns
        assert camera.malformed == 0
    finally:
        driver.kill()
        driver.communicate()
        camera.close()
        link.close()


def test_without_a_monitor_the_driver_ends_in_one_line():
    code = block("python").replace(DEFAULT_ENDPOINT, endpoint := free_endpoint())
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == 1
    assert ended.stderr == f"nothing answers on {endpoint}; start the monitor or the router first\n"


def _read(camera: NetworkCamera, frames: list[Frame]) -> None:
    if isinstance(item := camera.read(), Frame):
        frames.append(item)


def test_the_attachment_is_one():
    note = from_json(block("json").encode(), FrameNote)
    image = raw_image(bytes(768 * 576), note, (768, 576))
    np.testing.assert_array_equal(image, np.zeros((576, 768)))
    assert note == FrameNote(**{k: v for k, v in json.loads(block("json")).items() if k != "schema"})


def test_the_configurations_alternatives_are_some(tmp_path: Path):
    """The lines of configs/network.yaml that are commented out, each in place of those that it replaces."""
    text = builtin_config("network.yaml").read_text().replace("gripper: ", f"gripper: {CONFIGS}/")
    alternatives = [(("# key: cell7",), ())]
    for commented, replaced in alternatives:
        changed = text
        for line in commented:
            assert changed.count(line) == 1, line
            changed = changed.replace(line, line.removeprefix("# "))
        for old, new in replaced:
            changed = changed.replace(old, new, 1)
        path = tmp_path / "network.yaml"
        path.write_text(changed)
        load_config(path)


def test_every_encoding_is_named():
    named = set(re.findall(r"`(\w+)`", PAGE))
    missing = {name for name in ENCODINGS if name not in named and not re.fullmatch(r"bayer_....16", name)}
    assert not missing
