"""What the benchmarks look at: cluttered simulator frames with motion, rendered beforehand and handed over in a ring.

The ring is played forwards and backwards, so that creep and background move on steadily however long it runs.  On the
way back the last bit of every pixel is the other one: no sensor repeats an image to the bit, and pixels that do are
recognised as old.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import tags
from benchmarks.machine import ROOT
from gripmon.daemon.config import Config, load_config
from gripmon.model.camera import PaperLens, make_camera
from gripmon.model.records import Frame
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import Background, Bump, Cover, Creep

FPS = 60.0
WARM_UP_PACED = 30
"""Frames at the camera's rate after which everything is as it stays."""
_START_NS = 1_700_000_000_000_000_000
_DEMO_HEIGHT_PX = 576
_CREEP = (3e-4, 1.5e-4)
_GOES_BEFORE = 30
_COVERED_WITHIN = 12  # frames
_AWAY_M = 0.3  # three times as wide as the view at the fingertips
_CLUTTER = Background(kind="printed", boxes=45, cables=14, contrast=0.9, speed_m_per_s=0.12)

KINDS = {
    "clutter": "boxes, cables and print move behind the gripper, while the mount creeps",
    "quiet": "the same without creep",
    "plain": "one shade behind the gripper, while the mount creeps",
    "hidden": "clutter; after half a second a hand covers the whole view",
    "lost": "clutter; after half a second the gripper has left the view",
}

Size = tuple[int, int]


@dataclass(frozen=True)
class Ring:
    """Rendered frames: ``images`` and ``tagged``, the same with a tag on each finger, (n, height, width) each; of kinds
    in which the gripper goes away ``gone`` (n,) says where nothing of it is in view, and none has tags.
    """

    images: NDArray[np.uint8]
    tagged: NDArray[np.uint8]
    jaw_openings_m: NDArray[np.float64]
    true_tcp_m: NDArray[np.float64]
    gone: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.images)

    @property
    def size(self) -> Size:
        """Width and height, px."""
        return self.images.shape[2], self.images.shape[1]

    def place(self, seq: int) -> int:
        """Which of the images is frame ``seq``: 0, 1, …, n - 1, n - 2, …, 1, 0, 1, …"""
        period = 2 * (len(self) - 1)
        return min(seq % period, period - seq % period)

    @cached_property
    def _images_back(self) -> NDArray[np.uint8]:
        return self.images ^ 1

    def frame(self, seq: int) -> Frame:
        place, back = self.place(seq), seq % (2 * (len(self) - 1)) >= len(self)
        stamp_ns = _START_NS + round(seq * 1e9 / FPS)
        image = self._images_back[place] if back else self.images[place]
        return Frame(seq, stamp_ns, image, float(self.jaw_openings_m[place]))

    def save(self, path: Path) -> None:
        np.savez(path, **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)})

    @classmethod
    def load(cls, path: Path) -> Ring:
        with np.load(path) as arrays:
            return cls(**{name: arrays[name] for name in arrays.files})


def config_for(size: Size) -> Config:
    """The demo's configuration with a camera of another resolution that sees the same."""
    config = load_config(ROOT / "configs" / "demo.yaml", check_source=False)
    width_px, height_px = size
    scale = height_px / _DEMO_HEIGHT_PX
    lens = config.settings.camera
    assert isinstance(lens, PaperLens)
    lens = PaperLens(
        width_px=width_px,
        height_px=height_px,
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=0.5 * (width_px - 1),
        cy_px=0.5 * (height_px - 1),
        kappa_per_px2=lens.kappa_per_px2 / scale**2,
    )
    settings = msgspec.structs.replace(config.settings, camera=lens)
    return dataclasses.replace(config, settings=settings, camera=make_camera(lens))


def render(size: Size, count: int, step: Callable[[], object] = lambda: None, *, kind: str = "clutter") -> Ring:
    """A ring of ``count`` frames of a kind (:data:`KINDS`); ``step`` is called after each (for a progress bar)."""
    config, goes = config_for(size), kind in ("hidden", "lost")
    scenario = _scenario(kind, count)
    simulator = config.scene.simulator(scenario, seed=1)
    shape = (count, config.camera.height_px, config.camera.width_px)
    ring = Ring(
        np.zeros(shape, np.uint8),
        np.zeros((0 if goes else count, *shape[1:]), np.uint8),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count, bool),
    )
    rng = np.random.default_rng(1)
    for i in range(count):
        frame, truth = simulator.frame(i), simulator.truth(i)
        assert isinstance(frame.image, np.ndarray) and frame.jaw_opening_m is not None
        ring.images[i] = frame.image
        if not goes:
            ring.tagged[i] = tags.with_tags(ring.images[i], config.camera, truth.cam_T_grip, truth.jaw_opening_m, rng)
        ring.jaw_openings_m[i] = frame.jaw_opening_m
        ring.true_tcp_m[i] = truth.cam_T_grip[:3, 3]
        ring.gone[i] = goes and i >= _GOES_BEFORE + (_COVERED_WITHIN if kind == "hidden" else 0)
        step()
    return ring


def _scenario(kind: str, count: int) -> Scenario:
    mount: tuple[Creep | Bump, ...] = ()
    if kind in ("clutter", "plain"):
        mount = (Creep(law="linear", time_s=count / FPS, tcp_shift_m=_CREEP),)
    elif kind == "lost":
        # Between two frames: none shows it in both places.
        mount = (Bump(at_s=(_GOES_BEFORE - 0.5) / FPS, translation_m=(_AWAY_M, 0.0, 0.0), ring_fraction=0.0),)
    hand = Cover(start_s=(_GOES_BEFORE - 0.5) / FPS, end_s=1e4, move_s=(_COVERED_WITHIN - 0.5) / FPS)
    return Scenario(
        name="benchmark",
        duration_s=count / FPS,
        fps=FPS,
        mount=mount,
        covers=(hand,) if kind == "hidden" else (),
        background=Background(kind="plain", boxes=0, cables=0) if kind == "plain" else _CLUTTER,
    )
