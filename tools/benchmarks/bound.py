r"""How well any method could repeat itself: the Cramér-Rao bound of the edge pixels, and how near we come.

Each pixel p near an edge of the model is a measurement of the six parameters ξ of the pose (the published
perturbation, seven with the jaw opening): grey value I_p(ξ) plus independent Gaussian noise of variance σ_p².  The
Fisher information of all of them is

    F = Σ_p  (∂I_p/∂ξ)ᵀ (∂I_p/∂ξ) / σ_p²,

and no unbiased estimator has a smaller covariance than F⁻¹ (Cramér 1946, Rao 1945; for normal errors whose variance
hardly depends on ξ).  It is optimistic: the greys on both sides of each edge and the blur count as known.

∂I/∂ξ comes from central differences of the simulator's own picture without noise; σ² is what its sensor adds at that
grey value, read and shot noise, and the 1/12 DN² of rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy_runs import Track
from benchmarks.scenes import Scene
from gripmon.model.geometry import invert
from gripmon.model.records import Array
from gripmon.simulate.scenario import JawScript, Tilt

BOUND_ROW = "standing"
"""The condition in which nothing differs between frames but noise."""
NEAR_EDGE_PX = 3.0
_STEP_M, _STEP_RAD = 1e-5, 1e-4
_LEVER_M = 0.1
_SETTLED = 2
"""Frames of a scene that don't count: the monitor is on its way from the slightly wrong start."""


@dataclass(frozen=True)
class Bound:
    """Standard deviations (6,), m and rad, that no estimate can undercut: with the jaw opening known, and unknown."""

    jaw_known: Array
    jaw_unknown: Array


def pose_bound(scene: Scene) -> Bound:
    """The bound of one frame of a standing scene.  Its scenario must have neither vignetting nor a moving mount."""
    near = edge_pixels(scene)
    return bound_of(fisher_information(slopes(scene, near), variance(scene, near)))


def bound_of(information: Array) -> Bound:
    """From F (7, 7): pose (m, rad), then jaw opening (m)."""
    known = np.linalg.inv(information[:6, :6])
    return Bound(np.sqrt(np.diag(known)), np.sqrt(np.diag(np.linalg.inv(information))[:6]))


def fisher_information(slopes: Array, variance: Array) -> Array:
    """F (k, k) of pixels with slopes (p, k) and variances (p,)."""
    return np.asarray(np.einsum("pi,pj,p->ij", slopes, slopes, 1.0 / variance))


def variance(scene: Scene, near: NDArray[np.bool_]) -> Array:
    """Variance (p,) of the masked pixels, DN²."""
    simulator, sensor = scene.simulator, scene.simulator.scenario.sensor
    assert sensor.vignetting == 0.0 and not simulator.scenario.mount, "a standing scene without vignetting"
    light = simulator.light(0)[near].astype(float)
    return np.asarray(sensor.read_noise_dn**2 + sensor.shot_noise_dn * light + 1.0 / 12.0)


def slopes(scene: Scene, near: NDArray[np.bool_]) -> Array:
    """∂I/∂ξ (p, 7) of the masked pixels, DN per m or rad."""
    return np.column_stack([_slope(scene, k)[near] for k in range(7)])


def edge_pixels(scene: Scene) -> NDArray[np.bool_]:
    """Mask of the pixels within :data:`NEAR_EDGE_PX` of a visible edge of the gripper model."""
    truth = scene.simulator.truth(0)
    gripper, camera, pose = scene.gripper, scene.camera, truth.cam_T_grip
    points = gripper.points_grip_m(truth.jaw_opening_m)
    view = gripper.edge_view(points, invert(pose)[:3, 3])
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    for edge in np.flatnonzero(view.visible):
        ends = points[gripper.edge_points[edge]]
        line = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
        uv = np.round(camera.project(line @ pose[:3, :3].T + pose[:3, 3]))
        inside = (uv >= 0).all(axis=1) & (uv < [camera.width_px, camera.height_px]).all(axis=1)
        u, v = uv[inside].astype(int).T
        mask[v, u] = 1
    distance = np.asarray(cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5))
    return np.asarray(distance <= NEAR_EDGE_PX)


def _slope(scene: Scene, parameter: int) -> Array:
    """∂I/∂ξ_k (height, width), DN per m or rad, by central differences: 0-2 position, 3-5 rotation about the TCP,
    6 jaw opening.
    """
    if parameter < 3:
        way = np.eye(3)[parameter] * _STEP_M
        return (_moved(scene, translation_m=way) - _moved(scene, translation_m=-way)) / (2.0 * _STEP_M)
    if parameter == 6:
        return (_opened(scene, _STEP_M) - _opened(scene, -_STEP_M)) / (2.0 * _STEP_M)
    # The simulator rolls about lines that lead away from the camera: three of them span all rotations.
    lines = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
    slopes = [
        (_moved(scene, roll=(line, 1.0)) - _moved(scene, roll=(line, -1.0))) / (2.0 * _STEP_RAD) for line in lines
    ]
    return np.asarray(np.tensordot(np.linalg.inv(lines)[parameter - 3], np.array(slopes), axes=1))


def _moved(scene: Scene, translation_m: Array | None = None, roll: tuple[Array, float] | None = None) -> Array:
    """The picture after a small motion of the camera's mount, which leaves the faces' shades as they are."""
    own = scene.simulator
    tcp_m, line = own.truth(0).cam_T_grip[:3, 3], np.array([0.0, 0.0, 1.0]) if roll is None else roll[0]
    motion = Tilt(
        start_s=0.0,
        time_s=0.0,
        translation_m=tuple((np.zeros(3) if translation_m is None else translation_m).tolist()),
        roll_deg=0.0 if roll is None else float(np.rad2deg(roll[1] * _STEP_RAD)),
    )
    pivot_m = tuple((tcp_m - _LEVER_M * line).tolist())
    return _picture(scene, msgspec.structs.replace(own.scenario, mount=(motion,), pivot_cam_m=pivot_m))


def _opened(scene: Scene, more_m: float) -> Array:
    own = scene.simulator
    opening_m = own.truth(0).jaw_opening_m + more_m
    return _picture(scene, msgspec.structs.replace(own.scenario, jaw=JawScript(knots=((0.0, opening_m),))))


def _picture(scene: Scene, scenario: Any) -> Array:
    """The light of the second frame: at time zero, nothing has happened yet."""
    own = scene.simulator
    return own.rig.simulator(scenario, own.seed).light(1).astype(float)


def repeatability(track: Track, bounds: list[Bound]) -> dict[str, Any]:
    """Spread of the position in camera axes over each scene against its bound, root mean square over the scenes.

    Plain values: ``spread_um``, ``bound_um`` and ``ratio``, the root mean square of the scenes' ratios, for x, y, z;
    the bound with an unknown jaw opening beside it.
    """
    spreads = []
    for scene in range(len(bounds)):
        rows = (track.scene == scene) & (track.frame >= _SETTLED) & track.measured
        spreads.append(np.std(track.error[rows, :3], axis=0, ddof=1) if rows.sum() > 2 else np.full(3, np.nan))
    spread, bound = np.array(spreads), np.array([b.jaw_known[:3] for b in bounds])
    unknown = np.array([b.jaw_unknown[:3] for b in bounds])
    return {
        "spread_um": (1e6 * np.sqrt(np.nanmean(spread**2, axis=0))).tolist(),
        "bound_um": (1e6 * np.sqrt(np.mean(bound**2, axis=0))).tolist(),
        "bound_jaw_unknown_um": (1e6 * np.sqrt(np.mean(unknown**2, axis=0))).tolist(),
        "ratio": np.sqrt(np.nanmean((spread / bound) ** 2, axis=0)).tolist(),
    }
