"""Checks of where frames and jaw openings come from."""

from __future__ import annotations

from pathlib import Path

from gripmon.daemon.config.settings import JawSettings, Settings
from gripmon.daemon.config.typed import Fault
from gripmon.io.ros2.names import RosNameError, subscription_key
from gripmon.io.ros2.node import JOINT_STATE
from gripmon.io.sources import (
    FolderSettings,
    LiveSettings,
    NetworkSettings,
    SourceError,
    SourceSettings,
    VideoSettings,
    network_key,
)
from gripmon.io.sources.live import backend_number
from gripmon.io.wire import PublishSettings
from gripmon.model.gripper import Gripper

_NETWORK_JAWS = ("zenoh", "ros2_joint_state")


def jaw_fault(settings: Settings, gripper: Gripper) -> Fault | None:
    """What is wrong with the section ``jaw``, by itself and beside the others."""
    jaw = settings.jaw
    if jaw.source != "fixed" and not gripper.has_jaw:
        return Fault("jaw.source", f"is {jaw.source}, but the gripper file has no jaw", "fixed")
    if jaw.source == "frames" and (kind := _without_jaw(settings.source)) is not None:
        return Fault("jaw.source", f"is frames, but {kind} brings no jaw opening", "fixed or zenoh")
    if jaw.source in _NETWORK_JAWS and not settings.publish.enabled:
        right = "publish.enabled: true, or jaw.source: fixed"
        return Fault("jaw.source", f"is {jaw.source}, but publish.enabled is false", right)
    return _opening_fault(jaw, gripper) or _joint_fault(jaw)


def network_fault(source: SourceSettings, publish: PublishSettings) -> Fault | None:
    """Why a camera on the network can't be heard."""
    if not isinstance(source, NetworkSettings):
        return None
    if not publish.enabled:
        return Fault("source.kind", "is zenoh, but publish.enabled is false", "publish.enabled: true")
    try:
        network_key(source, "")
    except SourceError as error:
        return _fault_of(error)
    return None


def source_fault(source: SourceSettings, directory: Path) -> Fault | None:
    """A source of files that aren't there, or a camera that can't be any; paths count from ``directory``."""
    if isinstance(source, FolderSettings) and not (directory / source.path).is_dir():
        wrong = f"there is no folder {directory / source.path}"
        return Fault("source.path", wrong, "a folder with images, relative to this file")
    if isinstance(source, VideoSettings) and not (directory / source.path).is_file():
        wrong = f"there is no file {directory / source.path}"
        return Fault("source.path", wrong, "a video file, relative to this file")
    if isinstance(source, LiveSettings):
        try:
            backend_number(source)
        except SourceError as error:
            return _fault_of(error)
    return None


def _fault_of(error: SourceError) -> Fault:
    key, _, text = str(error).partition(": ")
    wrong, _, right = text.partition("; ")
    return Fault(f"source.{key}", wrong, right)


def _without_jaw(source: SourceSettings) -> str | None:
    """What brings frames without a jaw opening, in words; None if they may have one."""
    if isinstance(source, LiveSettings):
        return "a camera"
    if isinstance(source, VideoSettings):
        return "a video"
    if isinstance(source, NetworkSettings) and source.format.startswith("ros2_"):
        return "an image of ROS 2"
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


def _joint_fault(jaw: JawSettings) -> Fault | None:
    """``topic`` and ``opening`` belong to joint states, and joint states need both."""
    needed = jaw.source == "ros2_joint_state"
    for key, value, right in (
        ("topic", jaw.topic, "the full name of a topic, /joint_states"),
        ("opening", jaw.opening, "a section: joints (their names), scale, offset_m"),
    ):
        if needed and value is None:
            return Fault(f"jaw.{key}", "is missing", right)
        if not needed and value is not None:
            wrong = f"has no effect with jaw.source {jaw.source}"
            return Fault(f"jaw.{key}", wrong, f"jaw.source: ros2_joint_state, or no {key}")
    if jaw.topic is None:
        return None
    try:
        subscription_key(jaw.domain_id, jaw.topic, JOINT_STATE)
    except RosNameError as error:
        wrong, _, right = str(error).partition("; ")
        return Fault("jaw.topic", wrong, right)
    return None
