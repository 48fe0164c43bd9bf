"""The image pairs of ``tools/bench series``: where they come from, and what the variants make of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import rendered
from gripmon.daemon.config import builtin_config, load_config
from gripmon.judge.recalibrate import RecalibrationRefused, recalibrate
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.simulate import Simulator, make_scenario
from gripmon.simulate.scenario import Background
from gripmon.track.differential import DegenerateGeometry, differential_update
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings, Patience
from gripmon.track.edges.settings import SamplingSettings

_RENDERED = "rendered series2, true jaw"
_ITERATIONS = 5
"""Linearisations of an update from the reference, some degrees away: as many as change anything."""

SETTINGS = MeasurementSettings(sampling=SamplingSettings(samples=960))
"""A pair is not a stream of frames: edges are sampled at every pixel, for which 960 profiles suffice."""

CLUTTER = Background(kind="speckle")
_EVERYWHERE = Patience(when_doubtful=True, when_lost=True)
_USUAL_SHARE = 0.9
_NEEDED = {"3P": 3, "4P": 4, "5P": 5, "all": 3}


@dataclass(frozen=True, slots=True)
class Shot:
    """An image, the pose that is true for it, and the jaw opening."""

    image: Image
    cam_T_grip: Array
    jaw_opening_m: float


class Series(Protocol):
    """Pairs of images before and after a disturbance.  ``name`` as in the paper's tables, ``scene`` in words."""

    @property
    def name(self) -> str: ...

    @property
    def scene(self) -> str: ...

    @property
    def camera(self) -> Camera: ...

    @property
    def gripper(self) -> Gripper: ...

    def __len__(self) -> int: ...

    def pairs(self) -> Iterator[tuple[Shot, Shot]]: ...


@dataclass(frozen=True)
class SimulatedSeries:
    name: str
    scene: str
    simulator: Simulator

    @property
    def camera(self) -> Camera:
        return self.simulator.camera

    @property
    def gripper(self) -> Gripper:
        return self.simulator.gripper

    def __len__(self) -> int:
        return self.simulator.frame_count // 2

    def pairs(self) -> Iterator[tuple[Shot, Shot]]:
        for k in range(len(self)):
            yield self._shot(2 * k), self._shot(2 * k + 1)

    def _shot(self, index: int) -> Shot:
        truth = self.simulator.truth(index)
        return Shot(self.simulator.render(index), truth.cam_T_grip, truth.jaw_opening_m)


@dataclass(frozen=True)
class RenderedSeries:
    """The second series by an independent renderer; even frames are taken before, odd ones after the disturbance."""

    name: str
    scene: str
    sequence: rendered.Rendered

    @property
    def camera(self) -> Camera:
        return self.sequence.camera

    @property
    def gripper(self) -> Gripper:
        return self.sequence.gripper

    def __len__(self) -> int:
        return len(self.sequence.frames) // 2

    def pairs(self) -> Iterator[tuple[Shot, Shot]]:
        shots = [Shot(np.asarray(s.frame.image), s.cam_T_grip, s.jaw_opening_m) for s in self.sequence.shots()]
        yield from zip(shots[::2], shots[1::2], strict=True)


def all_series(seed: int) -> list[Series]:
    """The paper's two series from the simulator, on the plate and in the air, and the rendered second one if it is
    there.
    """
    config = load_config(builtin_config("demo.yaml"), check_source=False)

    def simulated(name: str, scene: str, **changes: object) -> SimulatedSeries:
        scenario = msgspec.structs.replace(make_scenario(name), **changes)
        return SimulatedSeries(name, scene, config.scene.simulator(scenario, seed))

    out: list[Series] = []
    for name in ("series1", "series2"):
        out += [
            simulated(name, f"`gripmon simulate {name} --seed {seed}`: parked on the plate, as in the paper"),
            simulated(name, "the same poses in the air, moving clutter behind", background=CLUTTER),
        ]
    out += [RenderedSeries("series2", "independent renderer, moving clutter", s) for s in rendered.sequences(_RENDERED)]
    return out


def measure(
    series: Series, variants: tuple[str, ...], progress: Callable[[], object]
) -> dict[str, list[tuple[float, float, float]]]:
    """For each variant the errors of the TCP in camera x, y, z, mm, of the pairs that it gives an estimate for."""
    errors_mm: dict[str, list[tuple[float, float, float]]] = {variant: [] for variant in variants}
    for before, after in series.pairs():
        pair = MeasuredPair.measured(series.camera, series.gripper, before, after)
        for variant in variants:
            cam_T_grip = None if pair is None else pair.estimate(variant)
            if cam_T_grip is not None:
                x, y, z = (1e3 * (cam_T_grip[:3, 3] - after.cam_T_grip[:3, 3])).tolist()
                errors_mm[variant].append((x, y, z))
        progress()
    return errors_mm


@dataclass(frozen=True)
class MeasuredPair:
    """Both images of a pair measured; ``reference_T`` is the calibration before the disturbance."""

    gripper: Gripper
    reference_T: Array
    jaw_opening_m: float
    before: Measurement
    after: Measurement

    @classmethod
    def measured(cls, camera: Camera, gripper: Gripper, before: Shot, after: Shot) -> MeasuredPair | None:
        """Both images are measured from the reference, of the second nothing else is known; None where the gripper
        isn't found in one.
        """
        meter = FingertipMeter(camera, gripper, SETTINGS, jaw_sigma_m=0.0)
        first, second = (
            meter.measure(shot.image, before.cam_T_grip, shot.jaw_opening_m, _USUAL_SHARE, _EVERYWHERE)
            for shot in (before, after)
        )
        if not (first.trusted and second.trusted):
            return None
        return cls(gripper, before.cam_T_grip, before.jaw_opening_m, first, second)

    def estimate(self, variant: str) -> Array | None:
        """``cam_T_grip`` (4, 4) after the disturbance; None where there are too few corners."""
        if variant == "edges":
            # Like with like here, too: the motion between what was measured before and after.
            return self.after.cam_T_grip @ invert(self.before.cam_T_grip) @ self.reference_T
        corners, _, way = variant.partition("-")
        taken = self._taken(corners)
        if np.count_nonzero(taken) < _NEEDED[corners]:
            return None
        points_cam_m = self._model_cam_m()[taken]
        measured_xy = self.after.corners.xy[taken]
        before_xy, after_xy = (m.corners.joint_covariance_xy(taken) for m in (self.before, self.after))
        covariance_xy = before_xy + after_xy
        try:
            if way == "U":
                tcp_m = self.reference_T[:3, 3]
                update = differential_update(points_cam_m, measured_xy, covariance_xy, tcp_m, _ITERATIONS)
                return perturb(self.reference_T, update.xi)
            points_grip_m = (points_cam_m - self.reference_T[:3, 3]) @ self.reference_T[:3, :3]
            return recalibrate(points_grip_m, measured_xy, covariance_xy, self.reference_T).cam_T_grip
        except (DegenerateGeometry, RecalibrationRefused):
            return None

    def _taken(self, corners: str) -> NDArray[np.bool_]:
        usable = self.before.corners.usable & self.after.corners.usable
        return self.gripper.innermost_corners(usable, None if corners == "all" else _NEEDED[corners])

    def _model_cam_m(self) -> Array:
        """(c, 3) corners measured before, where their rays meet the planes of their known heights: equation (8)."""
        z_grip_m = self.gripper.points_grip_m(self.jaw_opening_m)[self.gripper.corner_points, 2]
        normal, tcp_m = self.reference_T[:3, 2], self.reference_T[:3, 3]
        rays = np.column_stack([self.before.corners.xy, np.ones(len(z_grip_m))])
        depth_m = (z_grip_m + normal @ tcp_m) / (rays @ normal)
        return rays * depth_m[:, None]
