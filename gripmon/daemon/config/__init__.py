"""A configuration file -> checked, typed settings with the camera, gripper and reference that they describe.

Every fault is found here, before anything starts, and reported in one line: :class:`ConfigError`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from gripmon.daemon.config.calibrated import CalibrationFiles, with_sections
from gripmon.daemon.config.calibrated import mismatch as calibrated_mismatch
from gripmon.daemon.config.checks import (
    View,
    jaw_fault,
    joined,
    monitor_fault,
    network_fault,
    order_fault,
    predict_view,
    source_fault,
    view_fault,
)
from gripmon.daemon.config.earlier import without_gone
from gripmon.daemon.config.reference import reference_of
from gripmon.daemon.config.settings import Settings
from gripmon.daemon.config.typed import ConfigError, Fault, faults_of, to_settings
from gripmon.daemon.config.yaml_file import builtin_config, named_file, read_configuration, read_settings
from gripmon.io.sources import LiveSettings, NetworkSettings, Ros2CameraSettings, SimulatedSettings
from gripmon.io.wire import Joining
from gripmon.judge.statefile import AUTO, Owner, calibration_of, default_path
from gripmon.model.camera import Camera, make_camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import LARGEST_EXTENT_M, AxisMotion, Gripper, GripperModel, TableMotion
from gripmon.model.project import file_of
from gripmon.model.records import Array, ReferenceRecord
from gripmon.track.edges import TaughtEdges, TaughtModel
from gripmon.track.edges.taught import mismatch, own_covariance

if TYPE_CHECKING:
    from gripmon.simulate import Rig, Scenario

__all__ = [
    "Config",
    "ConfigError",
    "Settings",
    "builtin_config",
    "check_network",
    "load_config",
    "load_scenario",
    "read_gripper",
]


@dataclass(frozen=True, slots=True)
class Config:
    """A consistent configuration."""

    path: Path
    settings: Settings
    camera: Camera
    gripper: Gripper
    gripper_path: Path
    reference: ReferenceRecord
    taught: TaughtModel | None = None
    calibrated: CalibrationFiles = field(default_factory=CalibrationFiles)
    says_response: bool = True
    """Whether the file itself says ``monitor.corners.edges.response``; else a taught model does, or the reference's
    file.
    """

    @property
    def knows_response(self) -> bool:
        """Whether anything says how grey levels follow the light; else linear is assumed."""
        return self.says_response or self.taught is not None or self.calibrated.response is not None

    @property
    def taught_edges(self) -> TaughtEdges | None:
        """The taught edges for the monitor; None without a taught model.

        The error that they carry is that of the reference in the file, which they were taught at, and not of one that
        has replaced it here since (:attr:`reference`).
        """
        if self.taught is None:
            return None
        reference = reference_of(self.settings.reference)
        return TaughtEdges.of_model(self.taught, self.gripper, own_covariance(reference, self.gripper))

    @property
    def taught_path(self) -> Path | None:
        """The file of the taught model, whether it exists or not; None: none is named."""
        return None if self.settings.taught is None else self.directory / self.settings.taught

    @property
    def state_path(self) -> Path | None:
        """The file for the state that survives a restart; None: no state is kept."""
        settings = self.settings
        if settings.state.file != AUTO:
            return None if settings.state.file is None else self.directory / settings.state.file
        # A replay or simulation begins again each time, and so does its camera's motion.
        live = isinstance(settings.source, LiveSettings | NetworkSettings | Ros2CameraSettings)
        return default_path(settings.robot, settings.camera_name) if live else None

    @property
    def state_owner(self) -> Owner:
        """The owner of the state: robot, camera and calibration."""
        settings = self.settings
        calibration = calibration_of(settings.camera, self.gripper.model, self.reference)
        return Owner(settings.robot, settings.camera_name, calibration)

    @property
    def directory(self) -> Path:
        """The folder to which paths in the file are relative."""
        return self.path.parent

    @property
    def cam_T_grip(self) -> Array:
        """The reference calibration (4, 4)."""
        return from_record(self.reference.cam_T_grip)

    @property
    def jaw_opening_m(self) -> float | None:
        """The fixed jaw opening (m), the nominal one if it has another source; None for a gripper without jaw."""
        if not self.gripper.has_jaw:
            return None
        return self.gripper.jaw_nominal_m if self.settings.jaw.opening_m is None else self.settings.jaw.opening_m

    @property
    def scene(self) -> Rig:
        """What a simulated camera sees; undisturbed, it is at the reference."""
        from gripmon.simulate import Rig

        return Rig(self.camera, self.gripper, self.cam_T_grip)

    def view(self) -> View:
        """What should be visible at the reference and :attr:`jaw_opening_m`."""
        return predict_view(self.camera, self.gripper, self.cam_T_grip, self.jaw_opening_m)


def load_config(
    path: str | Path,
    *,
    check_source: bool = True,
    with_taught: bool = True,
    say_gone: bool = True,
    text: str | None = None,
    taught: TaughtModel | None = None,
) -> Config:
    """Read and check a configuration, a file or a project's folder that holds one.  Raises :class:`ConfigError`.

    ``check_source=False``: don't check that the source's files exist, for callers with their own input;
    ``with_taught=False``: ignore the taught model, for callers that teach it again; ``say_gone=False``: of settings
    that are gone only those that had an effect are told, for files that can't be edited.  ``text``: what the file will
    hold, and ``taught`` its taught model, where these aren't written yet.
    """
    path = file_of(path, "config")
    values = read_configuration(path, text)
    values, calibrated = with_sections(path, without_gone(path, values, say=say_gone))
    settings = read_settings(path, Settings, values)
    camera = _camera(path, settings, calibrated)
    gripper_path = named_file(path, "gripper", settings.gripper, "a gripper file")
    gripper = read_gripper(gripper_path)
    reference = _reference(path, settings, gripper, calibrated)
    said = "response" in _within(values, "monitor", "corners", "edges")
    if not said and calibrated.response is not None:
        monitor = settings.monitor.with_response(calibrated.response)
        settings = msgspec.structs.replace(settings, monitor=monitor)
    config = Config(path, settings, camera, gripper, gripper_path, reference, None, calibrated, said)
    fault = (
        monitor_fault(settings.monitor)
        or order_fault(settings)
        or network_fault(settings.source, settings.publish)
        or jaw_fault(settings, gripper)
        or _ros2_fault(settings)
        or view_fault(config.view(), gripper, camera)
    )
    if fault is None and check_source:
        fault = source_fault(settings.source, path.parent)
        if isinstance(settings.source, SimulatedSettings) and settings.source.scenario.endswith((".yaml", ".yml")):
            load_scenario(path.parent / settings.source.scenario)
    if fault is not None:
        raise ConfigError.of(path, fault)
    return _with_taught(config, taught) if with_taught else config


def _within(values: object, *keys: str) -> dict[str, object]:
    """The section at these keys, one within the other; empty if it isn't there."""
    for key in keys:
        values = values.get(key) if isinstance(values, dict) else None
    return values if isinstance(values, dict) else {}


def check_network(config: Config) -> Joining | None:
    """How the network would be joined; None if nothing is published.

    Checks what matters only for joining it: Zenoh configuration files, endpoints, packages for ROS 2.  Raises
    :class:`ConfigError`.
    """
    with faults_of(config.path):
        return joined(config.settings, config.directory)


def _camera(path: Path, settings: Settings, calibrated: CalibrationFiles) -> Camera:
    try:
        return make_camera(settings.camera)
    except ValueError as error:
        raise ConfigError(calibrated.paths.get("camera", path), "", f"camera.{error}") from None


def read_gripper(gripper_path: Path) -> Gripper:
    """Read and check a gripper file.  Raises :class:`ConfigError`."""
    model = read_settings(gripper_path, GripperModel)
    # Checked first: points in millimetres break most other rules, too.
    for name, point in model.points.items():
        if max(map(abs, point.xyz_m)) > LARGEST_EXTENT_M:
            wrong = f"{max(map(abs, point.xyz_m)):g} m from the TCP"
            raise ConfigError(gripper_path, f"points.{name}.xyz_m", wrong, "metres (millimetres were meant?)")
    with faults_of(gripper_path):
        for name, finger in model.fingers.items():
            for form, motion in (("axis", AxisMotion), ("table", TableMotion)):
                if finger.motion is not None and set(finger.motion) == {form}:
                    to_settings(finger.motion, motion, f"fingers.{name}.motion")
        return Gripper(model)


def _reference(path: Path, settings: Settings, gripper: Gripper, calibrated: CalibrationFiles) -> ReferenceRecord:
    file, made = calibrated.paths.get("reference", path), calibrated.hand_eye
    fault = None if made is None else calibrated_mismatch(made.camera, made.gripper, settings.camera, gripper)
    if fault is not None:
        raise ConfigError.of(file, fault)
    with faults_of(file, "reference." if file is path else ""):
        return reference_of(settings.reference)


def _with_taught(config: Config, model: TaughtModel | None = None) -> Config:
    """The configuration with its taught model, if it names one; refused unless it was taught with the same camera,
    gripper and settings.  What the file doesn't say of the grey levels' response holds as taught.
    """
    settings = config.settings
    if settings.taught is None:
        return config
    path = config.directory / settings.taught
    if model is None:
        path = named_file(config.path, "taught", settings.taught, "a file of gripmon teach")
        model = read_settings(path, TaughtModel)
    if not config.says_response:
        monitor = settings.monitor.with_response(model.edge_settings.response)
        settings = msgspec.structs.replace(settings, monitor=monitor)
    edges = settings.monitor.corners.edges
    fault = mismatch(model, config.camera, config.gripper, config.cam_T_grip, edges)
    if fault is not None:
        raise ConfigError(path, *fault)
    return replace(config, settings=settings, taught=model)


def _ros2_fault(settings: Settings) -> Fault | None:
    fault = settings.ros2.fault(settings.robot, settings.camera_name)
    return None if fault is None else Fault(*fault)


def load_scenario(path: Path) -> Scenario:
    """A simulator scenario from a YAML file.  Raises :class:`ConfigError`."""
    from gripmon.simulate import Scenario

    return read_settings(path, Scenario)
