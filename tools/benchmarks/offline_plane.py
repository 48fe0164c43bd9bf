"""Trials of the Plane Coincidence Constraint on images, for ``tools/bench offline``: found plate, measured corners,
``cam_T_grip``, and the tool centre point held against the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2, ncx2

from benchmarks import kit
from benchmarks.offline_images import DISCS, OPENING_M, Setting, gripper
from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.detection import detect
from gripmon.calibrate.plane import Coincidence, KnownCorners, calibrate_plane
from gripmon.calibrate.plane_average import average
from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
from gripmon.calibrate.single_view import calibrate_single_view
from gripmon.model.camera import make_camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.records import Array, Image
from gripmon.simulate import PAPER_LENS
from gripmon.simulate.scenario import Sensor
from gripmon.teach.hand_eye import KnownGripper, UnknownGripper

ROUGH_PX = 4.0
"""Someone clicks on corners; they are off by up to so much."""
PRINT_M = 5e-5
TILT_RAD = float(np.radians(0.1))
GAP_M = 1e-4
NOISES_DN = (0.5, 1.0, 2.0, 4.0)
REVEALED_P = 1e-3
"""Probability below which the product says that the gripper doesn't stand on the plate."""
WAYS = ("known", "inferred", "single")
_RISE = 0.35


@dataclass
class Errors:
    """Of one way on one kind of plate.  ``error`` (n, 6): position of the TCP, then rotation, camera axes; ``nees``
    (n,) its normalised square; ``claimed_m`` (n, 3) standard deviations; ``refused``: why there was no result.
    """

    plate: str
    way: str
    error: list[Array] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    claimed_m: list[Array] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    @property
    def position_mm(self) -> Array:
        """(n, 3), sizes."""
        return 1e3 * np.abs(np.reshape(self.error, (-1, 6))[:, :3])

    @property
    def coverage(self) -> float:
        """Part of the results whose truth lies in the stated region of 95 %."""
        return float(np.mean(np.array(self.nees) < chi2.ppf(0.95, 6)))


@dataclass
class Revealed:
    """What doesn't coincide, at one image noise, seen by one way: ``count`` trials of which this many were detected, by
    the residuals or by the tilt and gap that the gripper's own edges give, no plate considered; ``apart`` (n, 3) those,
    rad, rad, m; ``shift_mm`` (n,) the TCP's error that follows.

    ``power`` (n,): probability with which the best test notices the true tilt and gap, ``corner_power`` (n,) the best
    one of the corners alone; by the covariances that are stated, of chi-squared statistics with three degrees of
    freedom, not central by ``m' C^-1 m`` for the means m: for normal errors the likelihood ratio's.
    """

    what: str
    noise_dn: float
    count: int = 0
    by_residuals: int = 0
    by_apart: int = 0
    apart: list[Array] = field(default_factory=list)
    shift_mm: list[float] = field(default_factory=list)
    power: list[float] = field(default_factory=list)
    corner_power: list[float] = field(default_factory=list)


def trials(count: int, seed: int, print_m: float, progress: Callable[[], object] = lambda: None) -> list[Errors]:
    """All ways on ``count`` images of one kind of plate."""
    plate = f"printed, {1e3 * print_m:g} mm" if print_m else "perfect"
    found = {way: Errors(plate, way) for way in WAYS}
    for number in range(count):
        rng = np.random.default_rng([seed, number, round(1e9 * print_m)])
        setting = Setting.random(rng, print_m=print_m)
        image = setting.simulators(number, (Sensor().read_noise_dn,))[0].render(0)
        sight = detect(image, DISCS, "")
        for way, errors in found.items():
            if isinstance(sight, NotFound):
                errors.refused.append(sight.reason)
                continue
            try:
                one = solve(way, setting, image, sight, rng)
            except CalibrationError as error:
                errors.refused.append(str(error))
                continue
            result = average([one], inferred=way == "inferred")
            error = perturbation_between(result.cam_T_grip, setting.cam_T_grip)
            errors.error.append(error)
            errors.nees.append(float(kit.nees(error, result.covariance)))
            errors.claimed_m.append(np.sqrt(result.covariance.diagonal()[:3]))
        progress()
    return list(found.values())


def solve(way: str, setting: Setting, image: Image, sight: Sighting, rng: np.random.Generator) -> Coincidence:
    """One image the way a person does it: rough corners, then everything else from the image.  ``single``: the camera
    is calibrated from the same image, too, as in the paper.  Raises :class:`CalibrationError`.
    """
    camera = GivenCamera(PAPER_LENS)
    if way == "single":
        single = calibrate_single_view(sight)
        camera = GivenCamera(single.camera, single.parameters, single.covariance)
    if way == "inferred":
        return UnknownGripper(camera).measure(image, sight, _rough(setting, _OUTLINE, rng)).coincidence
    known = KnownGripper(camera, gripper(), OPENING_M)
    return known.measure(image, sight, _rough(setting, {name: (name, None) for name in _SEEN}, rng)).coincidence


def revealed(count: int, seed: int, progress: Callable[[], object] = lambda: None) -> list[Revealed]:
    """A gripper that doesn't stand on the plate, at several noises of the image: what is detected.  Besides tilt and
    gap one that does stand: how often that is doubted.
    """
    kinds: dict[str, tuple[tuple[float, float], float]] = {
        "coincides": ((0.0, 0.0), 0.0),
        "tilted by 0.1 degrees about x": ((TILT_RAD, 0.0), 0.0),
        "tilted by 0.1 degrees about y": ((0.0, TILT_RAD), 0.0),
        "0.1 mm above the plate": ((0.0, 0.0), GAP_M),
    }
    out = []
    for kind, (what, (tilt_rad, gap_m)) in enumerate(kinds.items()):
        rows = [Revealed(what, noise) for noise in NOISES_DN]
        for number in range(count):
            rng = np.random.default_rng([seed, number, 1 + kind])
            setting = Setting.random(rng, tilt_rad=tilt_rad, gap_m=gap_m)
            simulators = setting.simulators(number, NOISES_DN)
            light = simulators[0].light(0)
            for simulator, row in zip(simulators, rows, strict=True):
                image = simulator.expose(light.copy(), 0)
                _look(row, setting, image, rng, np.array([-tilt_rad[0], -tilt_rad[1], gap_m]))
            progress()
        out += rows
    return out


def _look(row: Revealed, setting: Setting, image: Image, rng: np.random.Generator, true_apart: Array) -> None:
    sight = detect(image, DISCS, "")
    if isinstance(sight, NotFound):
        return
    try:
        one = solve("known", setting, image, sight, rng)
    except CalibrationError:
        return
    row.count += 1
    row.by_residuals += one.p_value < REVEALED_P
    row.by_apart += one.apart_p is not None and one.apart_p < REVEALED_P
    if one.tilt_rad is not None and one.gap_m is not None:
        row.apart.append(np.array([*one.tilt_rad, one.gap_m]))
    row.power.append(_power(one, true_apart))
    row.corner_power.append(_power(_by_corners(one), true_apart))
    shift = perturbation_between(one.cam_T_grip, setting.cam_T_grip)[:3]
    row.shift_mm.append(1e3 * float(np.linalg.norm(shift)))


def _by_corners(one: Coincidence) -> Coincidence:
    """The same image without the edges that leave the plate."""
    points_m = gripper().points_grip_m(OPENING_M)
    known = KnownCorners(
        points_m[[gripper().point_ids.index(name) for name in one.corners.names]],
        float(gripper().points_grip_m(OPENING_M)[:, 2].max()),
    )
    return calibrate_plane(GivenCamera(PAPER_LENS), one.sighting, replace(one.corners, free=None), known)


def _power(one: Coincidence, true_apart: Array) -> float:
    """0 where tilt and gap can't be determined."""
    if one.apart_covariance is None:
        return 0.0
    away = float(kit.nees(true_apart, one.apart_covariance))
    return float(ncx2.sf(chi2.isf(REVEALED_P, 3), 3, away)) if away > 0.0 else REVEALED_P


_SEEN = ("L_in_near", "L_in_far", "L_out_near", "R_in_near", "R_in_far", "R_out_near")
_OUTLINE = {
    f"{finger}_{name}": (f"{letter}_{point}", behind and f"{letter}_{behind}")
    for finger, letter in (("left", "L"), ("right", "R"))
    for name, point, behind in (
        ("inner_near", "in_near", None),
        ("inner_far", "in_far", None),
        ("outer_near", "out_near", None),
        ("rise_far", "in_far", "in_far_back"),
    )
}
"""Names of an outline: the gripper's point, or a place on the edge from it to another one."""


def _rough(
    setting: Setting, wanted: dict[str, tuple[str, str | None]], rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    model, points = gripper(), gripper().points_grip_m(OPENING_M)
    places = []
    for first, second in wanted.values():
        a = points[model.point_ids.index(first)]
        places.append(a if second is None else a + _RISE * (points[model.point_ids.index(second)] - a))
    uv = make_camera(PAPER_LENS).project(np.array(places) @ setting.cam_T_grip[:3, :3].T + setting.cam_T_grip[:3, 3])
    uv = uv + rng.uniform(-ROUGH_PX, ROUGH_PX, uv.shape)
    return {name: (float(u), float(v)) for name, (u, v) in zip(wanted, uv, strict=True)}
