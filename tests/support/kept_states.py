"""Configurations on still pictures, and states as they lie there when a monitor starts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gripmon.daemon.config import builtin_config, load_config
from gripmon.judge.references import ReferenceBook
from gripmon.judge.statefile import StateFile
from gripmon.model.geometry import from_record
from gripmon.model.records import MonitorState
from gripmon.simulate import Rig, make_scenario
from support.configurations import demo_in

DIFFERENT = 12
"""Pictures of one place: so many that one that comes again is not taken for a frozen camera's."""


def make_pictures(folder: Path, frames: int, *, knocked_every: int | None = None) -> Path:
    """A folder of many frames: the demo's camera, which stands still, or is knocked to and fro by 3.5 mm."""
    folder.mkdir()
    config = load_config(builtin_config("demo.yaml"))
    scenario = make_scenario("static", duration_s=DIFFERENT / 20.0, fps=20.0)
    knocked_T = config.cam_T_grip.copy()
    knocked_T[0, 3] += 0.0035
    for place, cam_T_grip in enumerate((config.cam_T_grip, knocked_T)):
        simulator = Rig(config.camera, config.gripper, cam_T_grip).simulator(scenario, 1)
        for i in range(DIFFERENT):
            image = simulator.frame(i).image
            assert image is not None and cv2.imwrite(str(folder / f"original{place}-{i}.bmp"), image)
    links = folder / "frames"
    links.mkdir()
    for i in range(frames):
        place = 0 if knocked_every is None else i // knocked_every % 2
        (links / f"{i:05d}.bmp").symlink_to(folder / f"original{place}-{i % DIFFERENT}.bmp")
    return links


def configuration(folder: Path, pictures: Path, endpoint: str, **more: object) -> Path:
    """The demo's camera and gripper on these pictures, a state file ``kept.json``, a client of a router."""
    sections = {
        "source": {"kind": "folder", "path": str(pictures), "fps": 60.0},
        "jaw": {"source": "fixed"},
        "publish": {"mode": "client", "connect": [endpoint]},
        "recording": {"enabled": False},
        "state": {"file": "kept.json"},
        **more,
    }
    return demo_in(folder, **sections)


def keep(path: Path, *moved_m: float) -> MonitorState:
    """A state as it may lie there: after the configured reference others, whose TCP lies beside it in x."""
    config = load_config(path)
    book = ReferenceBook(config.reference)
    for i, x_m in enumerate(moved_m):
        pose = from_record(config.reference.cam_T_grip)
        pose[0, 3] += x_m
        book.adopt(book.draft(pose, np.diag([1e-9] * 3 + [1e-7] * 3), 1_000_000_000 * (i + 1)))
    assert config.state_path is not None
    file = StateFile(config.state_path, config.state_owner, config.reference)
    state = MonitorState(book.history)
    assert file.write(state)
    file.close()
    return state
