"""Checks of several keys together, or beyond the file: the view of the gripper, pairs of limits, sources, network."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.hand_eye_formats import lies_along_x
from gripmon.daemon.config.reference import ALONG_X, IN_FRONT, OPTICAL, covariance_of
from gripmon.daemon.config.settings import JawSettings, Settings
from gripmon.daemon.config.typed import Fault, SettingsError
from gripmon.io.metrics import package_fault
from gripmon.io.ros2.node import Ros2Missing, check_rclpy, domain_of
from gripmon.io.sources import (
    EpisodeSettings,
    FolderSettings,
    LiveSettings,
    NetworkSettings,
    Ros2CameraSettings,
    SourceError,
    SourceSettings,
    VideoSettings,
)
from gripmon.io.sources.live import backend_number
from gripmon.io.wire import Joining, PublishSettings, joining
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, ValidBy
from gripmon.monitor import MonitorSettings
from gripmon.teach.visibility import FEWEST_CORNERS


@dataclass(frozen=True, slots=True)
class View:
    """The predicted view at one jaw opening: arrays over the gripper's edges and its landmarks, which are its corners
    if it has any.

    ``corners_px`` (c, 2): NaN outside the lens model's range; ``in_image``, ``visible`` (c,); ``edges_visible`` (e,).
    """

    corners_cam_m: Array
    corners_px: Array
    in_image: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    edges_visible: NDArray[np.bool_]


def reference_doubt(settings: Settings) -> str | None:
    """Why a transform that is valid by its absolute error may be farther off than its alert limit, in one line with
    what would be right; None where that isn't so.
    """
    reference, policy = settings.reference, settings.monitor.policy
    if policy.valid_by is not ValidBy.ABSOLUTE:
        return None
    sigmas = np.sqrt(np.reshape(covariance_of(reference), (6, 6)).diagonal())
    sigma_m, sigma_rad = float(sigmas[:3].max()), float(sigmas[3:].max())
    right = "or monitor.policy.valid_by: reference, if only motion since the reference matters"
    unstated = reference.covariance is None
    for key, is_unstated, assumed in (
        ("position_sigma_m", unstated and reference.position_sigma_m is None, f"{1e3 * sigma_m:g} mm"),
        ("rotation_sigma_rad", unstated and not reference.rotation_sigma_rad, f"{np.degrees(sigma_rad):.2g} degrees"),
    ):
        if is_unstated:
            return (
                f"reference.{key} isn't stated, {assumed} are assumed, but transforms are valid by their absolute "
                f"error; state what the reference is good to, {right}"
            )
    for key, limit, sigma, unit in (
        ("alert_limit_m", policy.alert_limit_m, sigma_m, "m"),
        ("alert_limit_rad", policy.alert_limit_rad, sigma_rad, "rad"),
    ):
        if limit < sigma:
            return (
                f"monitor.policy.{key} is {limit:g}, below the reference's own standard deviation of {sigma:.2g} "
                f"{unit}; at least that, a reference that is known better, {right}"
            )
    return None


def monitor_fault(settings: MonitorSettings) -> Fault | None:
    """A setting of the monitor that would have no effect."""
    if settings.measurement != "corners" and settings.update_corners != "all":
        return Fault(
            "monitor.update_corners",
            f"is {settings.update_corners}, but without effect while monitor.measurement is {settings.measurement}",
            "monitor.measurement: corners, or update_corners: all",
        )
    return None


def predict_view(camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None) -> View:
    """The view of the gripper that the calibration predicts."""
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    points_cam_m = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    corners_cam_m = points_cam_m[gripper.landmarks]
    corners_px = camera.project(corners_cam_m)
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    in_image: NDArray[np.bool_] = np.all((corners_px >= 0.0) & (corners_px <= last_px), axis=1)
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    return View(
        corners_cam_m,
        corners_px,
        in_image,
        gripper.points_visible(points_grip_m, eye_grip_m, gripper.landmarks) & in_image,
        gripper.edge_view(points_grip_m, eye_grip_m).visible,
    )


def view_fault(view: View, gripper: Gripper, camera: Camera) -> Fault | None:
    """Why too little of the gripper is visible with this calibration; None if enough is."""
    key = "reference.cam_T_grip"
    depths_m = view.corners_cam_m[:, 2]
    if not view.in_image.any() and lies_along_x(view.corners_cam_m.mean(axis=0)):  # a wide lens may see it there
        return Fault(key, f"puts all corners outside of the image, {ALONG_X}?", OPTICAL)
    if (depths_m <= 0.0).all():
        return Fault(key, "puts all corners of the gripper behind the camera", IN_FRONT)
    if (depths_m <= 0.0).any():
        name = gripper.landmark_ids[int(depths_m.argmin())]
        return Fault(key, f"puts corner {name} behind the camera (z = {depths_m.min():.4g} m)", IN_FRONT)
    if not view.in_image.any():
        u, v = np.nanmedian(view.corners_px, axis=0) if np.isfinite(view.corners_px).any() else (math.nan, math.nan)
        where = f"around ({u:.0f}, {v:.0f}) px" if math.isfinite(u) else "beyond what the lens maps"
        return Fault(
            key,
            f"puts all corners outside of the image, {where}",
            f"fingertips in {camera.width_px} x {camera.height_px} px (x right, y down, z forward; x, y, z, w)",
        )
    seen = int(view.visible.sum())
    if seen < FEWEST_CORNERS:
        names = ", ".join(c for c, v in zip(gripper.landmark_ids, view.visible, strict=True) if v) or "none"
        return Fault(
            key,
            f"shows {seen} corners ({names})",
            f"a calibration that shows at least {FEWEST_CORNERS} corners that no face hides",
        )
    return None


class _Pair(NamedTuple):
    """``lower`` and ``upper``: keys of one section; ``why`` the first must not exceed the second."""

    section: str
    lower: str
    upper: str
    why: str


_WARNS_FIRST = "a drift is a warning before it is an error"
_GROWS = "the pauses grow from the one to the other"
_PAIRS = (
    _Pair("monitor.policy", "warn_m", "limit_m", _WARNS_FIRST),
    _Pair("monitor.policy", "warn_rad", "limit_rad", _WARNS_FIRST),
    _Pair("monitor.recalibration", "frames", "most_frames", "the fewest frames that are averaged and the most"),
    _Pair("monitor.recalibration", "sure_sigma_m", "largest_sigma_m", "an operator is asked before it is refused"),
    _Pair("publish", "retry_first_s", "retry_longest_s", _GROWS),
)
_OF_A_CAMERA = (_Pair("source", "retry_first_s", "retry_longest_s", _GROWS),)


def order_fault(settings: Settings) -> Fault | None:
    """The first pair in the wrong order."""
    for pair in _PAIRS + _OF_A_CAMERA * isinstance(settings.source, LiveSettings):
        section = functools.reduce(getattr, pair.section.split("."), settings)
        lower, upper = getattr(section, pair.lower), getattr(section, pair.upper)
        if lower > upper:
            right = f"at most {pair.upper}, or a larger {pair.upper}: {pair.why}"
            return Fault(f"{pair.section}.{pair.lower}", f"{lower:g} is above {pair.upper}, {upper:g}", right)
    return None


def jaw_fault(settings: Settings, gripper: Gripper) -> Fault | None:
    """What is wrong with the section ``jaw``, by itself and together with other sections."""
    jaw = settings.jaw
    if jaw.source != "fixed" and not gripper.has_jaw:
        return Fault("jaw.source", f"is {jaw.source}, but the gripper file has no jaw", "jaw.source: fixed")
    if jaw.source == "frames" and (kind := _without_jaw(settings.source)) is not None:
        return Fault("jaw.source", f"is frames, but {kind} brings no jaw opening", "fixed or zenoh")
    if jaw.source == "zenoh" and not settings.publish.enabled:
        right = "publish.enabled: true, or jaw.source: fixed"
        return Fault("jaw.source", "is zenoh, but publish.enabled is false", right)
    if jaw.source != "frames" and isinstance(settings.source, Ros2CameraSettings) and settings.source.joint_states:
        return Fault("source.joint_states", f"has no effect with jaw.source {jaw.source}", "jaw.source: frames")
    return _opening_fault(jaw, gripper)


def network_fault(source: SourceSettings, publish: PublishSettings) -> Fault | None:
    """Why images from the network can't be received."""
    if isinstance(source, Ros2CameraSettings):
        fault = source.fault()
        return None if fault is None else Fault(*fault)
    if isinstance(source, NetworkSettings) and not publish.enabled:
        return Fault("source.kind", "is zenoh, but publish.enabled is false", "publish.enabled: true")
    return None


def source_fault(source: SourceSettings, directory: Path) -> Fault | None:
    """A source whose files don't exist, or an impossible camera; paths are relative to ``directory``."""
    if isinstance(source, FolderSettings) and not (directory / source.path).is_dir():
        wrong = f"there is no folder {directory / source.path}"
        return Fault("source.path", wrong, "a folder with images, relative to this file")
    if isinstance(source, VideoSettings) and not (directory / source.path).is_file():
        wrong = f"there is no file {directory / source.path}"
        return Fault("source.path", wrong, "a video file, relative to this file")
    if isinstance(source, EpisodeSettings) and "://" not in source.path and not (directory / source.path).exists():
        wrong = f"there is no file or folder {directory / source.path}"
        return Fault("source.path", wrong, "recorded messages or a LeRobot dataset, relative to this file")
    if isinstance(source, LiveSettings):
        try:
            backend_number(source)
        except SourceError as error:
            return Fault("", f"source.{error}", "")
    return None


def _without_jaw(source: SourceSettings) -> str | None:
    """The kind of source, in words, if its frames never have a jaw opening; None if they may."""
    if isinstance(source, LiveSettings):
        return "a camera"
    if isinstance(source, VideoSettings):
        return "a video"
    if isinstance(source, EpisodeSettings) and source.opening is None:
        return "a source without opening (joints, scale, offset_m)"
    if isinstance(source, Ros2CameraSettings) and source.joint_states is None:
        return "a source without joint_states and opening"
    return None


def _opening_fault(jaw: JawSettings, gripper: Gripper) -> Fault | None:
    if jaw.opening_m is None:
        return None
    if jaw.source != "fixed":
        wrong = f"has no effect with jaw.source {jaw.source}"
        return Fault("jaw.opening_m", wrong, "jaw.source: fixed, or no opening_m")
    if not gripper.has_jaw:
        return Fault("jaw.opening_m", "the gripper file has no jaw", "no opening_m")
    if not gripper.jaw_min_m <= jaw.opening_m <= gripper.jaw_max_m:
        span = f"{gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m"
        return Fault("jaw.opening_m", f"{jaw.opening_m:g} m is outside the gripper's range", span)
    return None


def joined(settings: Settings, directory: Path) -> Joining | None:
    """How the network would be joined; None if it won't be.  :class:`InputError` if it can't be."""
    if (missing := package_fault(settings.metrics)) is not None:
        raise SettingsError(Fault(*missing))
    if (fault := _ros2_missing(settings)) is not None:
        raise SettingsError(fault)
    return joining(settings.publish, directory) if settings.publish.enabled else None


def _ros2_missing(settings: Settings) -> Fault | None:
    """Why ROS 2 can't be joined as these settings want; None if it can, or none of them does."""
    domains: dict[str, int | None] = {}
    if isinstance(settings.source, Ros2CameraSettings):
        domains["source.kind"] = settings.source.domain_id
    if settings.ros2.enabled:
        domains["ros2.enabled"] = settings.ros2.domain_id
    for key, domain_id in domains.items():
        try:
            check_rclpy()
            domain_of(domain_id)
        except Ros2Missing as error:
            return Fault(key, str(error), "")
    return None
