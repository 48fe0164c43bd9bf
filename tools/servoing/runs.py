"""One run: four arms on the same images, which differ in where they have ``cam_T_grip`` from."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.harness import free_endpoint

from gripmon.client import Policy, Reading
from gripmon.model.geometry import invert
from gripmon.model.records import Array, Verdict
from gripmon.simulate import Simulator
from servoing import stage
from servoing.arm import Arm
from servoing.controller import Given, Servo, given_by
from servoing.eye import Eye, object_points_m
from servoing.feed import Feed, FeedError, feed, reference_cam_T_grip, write_config
from servoing.rules import Action

WITHOUT, GRIPMON, SMOOTHED, TRUTH = "without", "gripmon", "smoothed", "truth"
SOURCES = (WITHOUT, GRIPMON, SMOOTHED, TRUTH)

LIVE = Policy(accept_suspect=True, clocks_agree=True)
IN_FRAME_TIME = Policy(accept_suspect=True, max_age_s=3600.0)
"""Time is that of the frames: how long the machine takes for one makes no transform older."""


@dataclass(frozen=True)
class Track:
    """An arm's way, frame by frame.

    ``q`` (n, 6) and ``tcp_m`` (n, 3), base axes, when the image was taken; ``off_m`` (n, 3) from the object to the TCP,
    camera axes; ``action`` until the next frame; ``grasped``: whether the fingers have closed.
    """

    q: Array
    tcp_m: Array
    off_m: Array
    action: tuple[Action, ...]
    grasped: tuple[bool, ...]
    stopped_by_range: bool

    @property
    def distance_m(self) -> Array:
        return np.linalg.norm(self.off_m, axis=1)

    def moved(self) -> Array:
        """(n - 1,) whether any joint turned between a frame and the next."""
        return (np.diff(self.q, axis=0) != 0.0).any(axis=1)


@dataclass(frozen=True)
class Run:
    """``verdict``: the monitor's for each frame; ``missed``: frames of which nothing came."""

    row: stage.Row
    number: int
    time_s: Array
    verdict: tuple[Verdict, ...]
    revision: tuple[int, ...]
    missed: int
    tracks: dict[str, Track]


def run(row: stage.Row, number: int, seed: int, fps: float, *, realtime: bool, step: Callable[[], object]) -> Run:
    """Everything random follows from ``seed``, row and number.  Raises :class:`FeedError` if the monitor fails."""
    seeds = [seed, stage.ROWS.index(row), number]
    rng = np.random.default_rng(seeds)
    scenario = stage.scenario(row, rng, fps, reference_cam_T_grip()[:3, 3])
    arm = Arm()
    base_T_object, start = stage.placement(arm, rng)
    with tempfile.TemporaryDirectory(prefix="gripmon-servo-") as name:
        folder = Path(name)
        simulator_seed = int(rng.integers(2**32))
        config = write_config(folder, scenario, simulator_seed, free_endpoint(), realtime=realtime)
        simulator = config.scene.simulator(scenario, simulator_seed)
        assert scenario.grasped is not None
        eye = Eye(config.camera, object_points_m(scenario.grasped))
        arms = _Arms(simulator, eye, arm, base_T_object, start, fps, seeds)
        with feed(folder, config, LIVE if realtime else IN_FRAME_TIME) as monitor:
            _follow(arms, monitor, simulator, realtime=realtime, step=step)
    return arms.result(row, number, simulator.frame_count)


def _follow(arms: _Arms, monitor: Feed, simulator: Simulator, *, realtime: bool, step: Callable[[], object]) -> None:
    last_before = round(stage.BEGIN_S * simulator.scenario.fps) - 2
    for reading in monitor.readings(simulator.frame_count - 1):
        if not arms.readings and reading.seq > last_before:
            raise FeedError(f"the first transform that came was of frame {reading.seq}: too late for the approach")
        arms.frame(reading, reading.age_s if realtime else 0.0)
        step()
    if not arms.readings:
        raise FeedError("nothing came over the network")


class _Arms:
    """Four arms with one camera each, all cameras alike: its image of the fingertips doesn't depend on the arm."""

    def __init__(
        self, simulator: Simulator, eye: Eye, arm: Arm, base_T_object: Array, start: Array, fps: float, seeds: list[int]
    ) -> None:
        self.readings: list[Reading] = []
        self._simulator, self._eye, self._arm, self._seeds = simulator, eye, arm, seeds
        self._base_T_object = base_T_object
        self._servos = {source: Servo(arm, start, fps) for source in SOURCES}
        self._ways: dict[str, list[tuple[Array, Array, Array, Action, bool]]] = {source: [] for source in SOURCES}

    def frame(self, reading: Reading, age_s: float) -> None:
        """The arms have moved since the last frame; each sees the object and decides."""
        time_s = self._simulator.time_s(reading.seq)
        step_s = time_s - self._simulator.time_s(self.readings[-1].seq) if self.readings else 0.0
        self.readings.append(reading)
        truth = self._simulator.truth(reading.seq)
        values = {
            WITHOUT: Given(truth.reference_cam_T_grip, Verdict.VALID, 0.0),
            GRIPMON: given_by(reading, age_s, smoothed=False),
            SMOOTHED: given_by(reading, age_s, smoothed=True),
            TRUTH: Given(truth.cam_T_grip, Verdict.VALID, 0.0),
        }
        # The same errors of the detector for all arms: what differs is where they have the transform from.
        noise_px = self._eye.noise_px(np.random.default_rng([*self._seeds, 1, reading.seq]))
        for source, servo in self._servos.items():
            servo.advance(step_s)
            base_T_grip = self._arm.base_T_grip(servo.q)
            cam_T_object = truth.cam_T_grip @ invert(base_T_grip) @ self._base_T_object
            seen = None if "hand" in truth.events else self._eye.cam_T_object(cam_T_object, noise_px)
            servo.decide(time_s, step_s, values[source], seen)
            off_m = truth.cam_T_grip[:3, 3] - cam_T_object[:3, 3]
            self._ways[source].append((servo.q, base_T_grip[:3, 3], off_m, servo.action, servo.grasped))

    def result(self, row: stage.Row, number: int, frames: int) -> Run:
        tracks = {}
        for source, way in self._ways.items():
            q, tcp_m, off_m, action, grasped = zip(*way, strict=True)
            arrays = (np.array(q), np.array(tcp_m), np.array(off_m))
            tracks[source] = Track(*arrays, action, grasped, self._servos[source].stopped_by_range)
        return Run(
            row,
            number,
            np.array([self._simulator.time_s(reading.seq) for reading in self.readings]),
            tuple(reading.verdict for reading in self.readings),
            tuple(reading.revision for reading in self.readings),
            frames - len(self.readings),
            tracks,
        )
