"""The joint result of several images of a gripper on a calibration plate, and warnings about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import chdtrc

from gripmon.calibrate.plane import DOUBTED, Coincidence, corners_of, lengths_of
from gripmon.calibrate.plane_equations import FEWEST_CORNERS
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array

BESIDE_STEPS = 2.0
"""Distance beyond the visible points, in steps of the pattern, from which a corner counts as off the plate."""
DOUBTFUL_SIGMA_M = 1.5e-5
"""Standard deviation of the TCP above which one image of an inferred gripper gets a warning."""
LARGEST_TURN_RAD = np.pi / 2.0
"""Largest difference of rotation from a rough calibration (rad): none is off by as much."""
NOT_IN_COVARIANCE = "bevelled edges, and dark ones before dark print"
"""What shifts a whole edge, in every image alike, so that no residual shows it: fingers with chamfers of 0.1 mm had
their TCP seven of its standard deviations off.
"""
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class PlaneCalibration:
    """``cam_T_grip`` (4, 4) from all images, with ``covariance`` (6, 6) as in :class:`Coincidence`; ``corners_m`` (c,
    3) with ``lengths_covariance`` (s, s) of what was inferred (see :func:`lengths_of`; s = 0 for a known gripper).
    Both covariances are of noise, camera and print, without :data:`NOT_IN_COVARIANCE`.
    ``consistency_p``: probability of images that differ as much; None for one image.  ``warnings``: doubts, in words.
    """

    cam_T_grip: Array
    covariance: Array
    corners_m: Array
    lengths_covariance: Array
    images: tuple[Coincidence, ...]
    consistency_p: float | None
    warnings: tuple[str, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square residual on the plate, x and y each."""
        return float(np.sqrt(np.mean(np.square(np.concatenate([i.residuals_m for i in self.images])))))

    @property
    def rms_px(self) -> float:
        """Root mean square residual in the images, u and v each."""
        return float(np.sqrt(np.mean(np.square(np.concatenate([i.residuals_px for i in self.images])))))

    def table(self) -> list[str]:
        """For a person: a row for each image."""
        width = max(len(image.sighting.name) for image in self.images)
        compared = any(image.tilt_rad is not None for image in self.images)
        apart = "  tilt about x, y          gap" if compared else ""
        head = f"{'image':<{width}}  plate points     rms  corners  residual{apart}"
        return [head, *(_row(image, width) for image in self.images)]

    def summary(self) -> list[str]:
        """For a person: pose, lengths where they were inferred, and how certain they are."""
        lines = []
        if self.consistency_p is not None:
            lines = [f"the images agree with each other: probability {self.consistency_p:.2g} of differing as much"]
        sigma = (self.covariance.diagonal() ** 0.5).tolist()
        x, y, z = (1e3 * self.cam_T_grip[:3, 3]).tolist()
        sx, sy, sz = (1e3 * value for value in sigma[:3])
        rx, ry, rz = (math.degrees(value) for value in sigma[3:])
        lines.append(f"TCP in the camera frame  {x:.3f} {y:.3f} {z:.3f} mm  +- {sx:.4f} {sy:.4f} {sz:.4f} mm")
        lines.append(f"rotation about x, y, z   +- {rx:.4f} {ry:.4f} {rz:.4f} degrees")
        lines.append(f"+- of noise, camera and print; without {NOT_IN_COVARIANCE}")
        if len(self.lengths_covariance):
            sides, errors = 2e3 * self.corners_m[3, :2], 1e3 * self.lengths_covariance.diagonal()[:2] ** 0.5
            apart, along = (f"{side:.3f} +- {error:.4f} mm" for side, error in zip(sides, errors, strict=True))
            lines.append(f"fingertips {apart} apart, innermost edges {along} long")
        return lines


def _row(image: Coincidence, width: int) -> str:
    used, left_out = int(image.plate.used[0].sum()), int((~image.plate.used[0]).sum())
    points = f"{used}" + (f" (-{left_out})" if left_out else "")
    residual_mm = 1e3 * float((image.residuals_m**2).mean() ** 0.5)
    apart = ""
    if image.tilt_rad is not None and image.gap_m is not None:
        tilt = [math.degrees(angle) for angle in image.tilt_rad.tolist()]
        apart = f"  {tilt[0]:+.3f} {tilt[1]:+.3f} degrees   {1e3 * image.gap_m:+.4f} mm"
    rms_px, corners = image.plate.rms_px, len(image.corners.names)
    return f"{image.sighting.name:<{width}}  {points:>12} {rms_px:4.2f} px  {corners:7d} {residual_mm:6.4f} mm{apart}"


def average(images: Sequence[Coincidence], inferred: bool) -> PlaneCalibration:
    """The weighted mean of all images on the manifold, pose and inferred lengths jointly.

    Weights are the inverse of the images' covariances without the camera's part; errors of the camera, or of the
    plate's print, affect all images and aren't assumed to average out.  (Weights that omitted the print, too, would
    turn its large error along the line of sight into errors across it that differ between images.)  If the images
    differ by more than their covariances allow, the mean's covariance is enlarged accordingly (Birge, "The calculation
    of errors by the method of least squares", 1932), with a warning.  :class:`CalibrationError` for inferred grippers
    with different corners.
    """
    if inferred and len({i.corners.names for i in images}) > 1:
        raise CalibrationError("the images show different corners; for a gripper that is inferred the same in all")
    information = [_inverse(i.own @ i.own.T + i.printed @ i.printed.T) for i in images]
    total = np.linalg.inv(np.sum(information, axis=0))
    gains = [total @ i for i in information]
    cam_T_grip = images[0].cam_T_grip
    lengths = lengths_of(images[0].corners_m) if inferred else np.zeros(0)
    for _ in range(_ROUNDS):
        away = [_away(image, cam_T_grip, lengths) for image in images]
        mean = np.sum([g @ a for g, a in zip(gains, away, strict=True)], axis=0)
        cam_T_grip, lengths = perturb(cam_T_grip, mean[:6]), lengths + mean[6:]
    away = [_away(image, cam_T_grip, lengths) for image in images]
    size = float(sum(a @ i @ a for a, i in zip(away, information, strict=True)))
    freedom = len(total) * (len(images) - 1)
    consistency_p = float(chdtrc(freedom, size)) if freedom else None
    warnings = list(_of_images(images, inferred))
    own = np.sum([g @ i.own @ i.own.T @ g.T for g, i in zip(gains, images, strict=True)], axis=0)
    if consistency_p is not None and consistency_p < DOUBTED:
        own = own * (size / freedom)
        farthest = max(zip(images, away, strict=True), key=lambda both: float(np.linalg.norm(both[1][:3])))
        warnings.append(
            f"the images contradict each other (probability {consistency_p:.1g}), most of all "
            f"{farthest[0].sighting.name}, {1e3 * float(np.linalg.norm(farthest[1][:3])):.2f} mm off: the camera moved "
            f"between them, or the gripper didn't stand on the plate; uncertainty x {np.sqrt(size / freedom):.1f}"
        )
    common = np.sum([g @ i.common for g, i in zip(gains, images, strict=True)], axis=0)
    covariance = own + common @ common.T + _of_print([g @ i.printed for g, i in zip(gains, images, strict=True)])
    return PlaneCalibration(
        cam_T_grip,
        0.5 * (covariance + covariance.T)[:6, :6],
        corners_of(lengths) if inferred else images[0].corners_m,
        covariance[6:, 6:],
        tuple(images),
        consistency_p,
        tuple(dict.fromkeys(warnings)),
    )


def against(cam_T_grip: Array, rough_cam_T_grip: Array) -> str | None:
    """What is wrong with a calibration compared with a known rough one, in words; None if nothing is."""
    turned = float(np.linalg.norm(perturbation_between(rough_cam_T_grip, cam_T_grip)[3:]))
    if turned <= LARGEST_TURN_RAD:
        return None
    return (
        f"the gripper is turned by {np.degrees(turned):.0f} degrees against the rough calibration; corners by their "
        "right names (fingers, or near and far, have changed places), an image that isn't upside down"
    )


def _away(image: Coincidence, cam_T_grip: Array, lengths: Array) -> Array:
    """(6 + s,) difference from a pose and lengths to those of an image."""
    pose = perturbation_between(cam_T_grip, image.cam_T_grip)
    return np.concatenate([pose, lengths_of(image.corners_m) - lengths]) if len(lengths) else pose


def _of_print(slopes: Sequence[Array]) -> Array:
    """A covariance (6 + s, 6 + s) that bounds the images' errors due to the print, each (6 + s, k), whatever their
    correlation.

    Which of the print's errors an image shows, and how they affect the pose, depends on where the plate lies in it.
    For weights w that sum to one, the sum of C / w over the images is never below the covariance of the sum of the
    errors (Cauchy-Schwarz); with w proportional to their sizes it is also the smallest such sum, and equal images count
    as one.
    """
    parts = [slope @ slope.T for slope in slopes]
    scale = np.maximum(np.sum(parts, axis=0).diagonal(), 1e-300)
    sizes = np.array([np.sqrt((part.diagonal() / scale).sum()) for part in parts])
    per_weight = [sizes.sum() / size if size > 0.0 else 0.0 for size in sizes]
    out: Array = np.sum([part * per for part, per in zip(parts, per_weight, strict=True)], axis=0)
    return out


def _inverse(covariance: Array) -> Array:
    """Inverse of a matrix whose rows have different units; one direction may be known far better than another."""
    scale = np.sqrt(covariance.diagonal())
    return np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)


def _of_images(images: Sequence[Coincidence], inferred: bool) -> list[str]:
    out = []
    for image in images:
        name = f"{image.sighting.name}: " if image.sighting.name else ""
        out += [name + text for text in doubts(image, inferred)]
    return out


def doubts(image: Coincidence, inferred: bool) -> list[str]:
    """Doubts about one image, in words."""
    out = []
    names = image.corners.names
    if len(names) == FEWEST_CORNERS:
        out.append(f"two corners only ({', '.join(names)}): nothing but their distance checks them")
    if image.p_value < DOUBTED:
        worst = int(np.linalg.norm(image.residuals_m, axis=1).argmax())
        size_mm = 1e3 * float(np.linalg.norm(image.residuals_m[worst]))
        what = "don't form a rectangle" if inferred else "don't fit the gripper file"
        out.append(
            f"the corners {what} (probability {image.p_value:.1g}), most of all {names[worst]}, {size_mm:.3f} mm off: "
            "another jaw opening, another target, a bent finger, or fingertips that don't stand on the plate; "
            f"uncertainty x {image.enlarged:.1f}"
        )
    if image.apart_p is not None and image.apart_p < DOUBTED:
        out.append(_apart_text(image))
    own_mm = 1e3 * float(np.sqrt(np.linalg.eigvalsh(image.own[:3] @ image.own[:3].T)[-1]))
    if inferred and own_mm > 1e3 * DOUBTFUL_SIGMA_M:
        out.append(
            f"the inferred corners leave the TCP uncertain by {own_mm:.3f} mm (standard deviation): where the fingers' "
            "edges hardly stand out from the plate's print, they are seen along a part only; a plate of discs, light "
            "fingers before dark print or the reverse, or more images"
        )
    beside = [n for n, off in zip(names, _beside(image.sighting, image.plate_xy_m), strict=True) if off]
    if beside:
        out.append(f"off the part of the plate that is seen: {', '.join(beside)}; the gripper amid the pattern")
    return out


def _apart_text(image: Coincidence) -> str:
    assert image.tilt_rad is not None and image.gap_m is not None and image.apart_sigma is not None
    tilt, sigma = np.degrees(image.tilt_rad), np.degrees(image.apart_sigma[:2])
    judged = "by all its edges" if image.corners.free is not None else "by its corners"
    return (
        f"the fingertips don't stand on the plate ({judged}; probability {image.apart_p:.1g}): tilted by "
        f"{tilt[0]:+.2f} +- {sigma[0]:.2f} and {tilt[1]:+.2f} +- {sigma[1]:.2f} degrees about x and y, "
        f"{1e3 * abs(image.gap_m):.3f} +- {1e3 * image.apart_sigma[2]:.3f} mm "
        f"{'above' if image.gap_m > 0.0 else 'below'} it"
    )


def _beside(sighting: Sighting, plate_xy_m: Array) -> list[bool]:
    """Which points lie clearly outside the visible pattern."""
    seen = sighting.plate_m[:, :2]
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    step_m = float(np.median(apart.min(axis=1)))
    hull = cv2.convexHull((seen / step_m).astype(np.float32))
    return [cv2.pointPolygonTest(hull, (x / step_m, y / step_m), True) < -BESIDE_STEPS for x, y in plate_xy_m.tolist()]
