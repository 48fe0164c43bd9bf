"""The configuration of a second camera: a laser calibration to be watched, instead of a gripper and a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gripmon.calibrate.sighting import CalibrationError
from gripmon.daemon.config.checks import network_fault, source_fault
from gripmon.daemon.config.settings import SecondSettings
from gripmon.daemon.config.typed import ConfigError, Fault
from gripmon.daemon.config.yaml_file import named_file, read_configuration, read_document, read_settings
from gripmon.io.sources import EpisodeSettings, FolderSettings, SimulatedSettings, VideoSettings
from gripmon.laser.judgement import SpotWatchSettings
from gripmon.laser.matching import PulseSettings, ReportedPulse, read_pulses
from gripmon.laser.setup import LaserCalibration
from gripmon.laser.watching import PulsedWatch
from gripmon.model.camera import Camera, make_camera
from gripmon.model.errors import InputError

SECTION = "laser"
_LASER_FILE = "a file of gripmon calibrate laser"
_OF_A_WRIST = ("gripper", "reference", "taught", "jaw", "monitor", "ros2", "state")


@dataclass(frozen=True, slots=True)
class SecondConfig:
    """A consistent configuration.  ``pulses``: those of a table; empty if they come over the network."""

    path: Path
    settings: SecondSettings
    calibration_path: Path
    calibration: LaserCalibration
    camera: Camera
    pulses: tuple[ReportedPulse, ...] = ()

    @property
    def directory(self) -> Path:
        """The folder to which paths in the file are relative."""
        return self.path.parent

    def pulsed_watch(self) -> PulsedWatch:
        """A new watch."""
        laser = self.settings.laser
        return PulsedWatch(self.calibration, laser.watch, laser.frames)


def is_second(path: Path) -> bool:
    """Whether this is the configuration of a second camera.  Raises :class:`ConfigError` for a file that isn't YAML."""
    return SECTION in read_configuration(path)


def load_second(path: Path, *, check_source: bool = True) -> SecondConfig:
    """Read and check a configuration file.  Raises :class:`ConfigError`.

    ``check_source=False``: don't check that the source's files exist, and don't read the pulses.
    """
    values = read_configuration(path)
    _refuse_wrist(path, values)
    settings = read_settings(path, SecondSettings, values)
    calibration_path = named_file(path, f"{SECTION}.calibration", settings.laser.calibration, _LASER_FILE)
    calibration = read_laser(calibration_path)
    fault = _fault_between(settings) or network_fault(settings.source, settings.publish)
    if fault is None and check_source:
        fault = source_fault(settings.source, path.parent)
    if fault is not None:
        raise ConfigError.of(path, fault)
    config = SecondConfig(path, settings, calibration_path, calibration, make_camera(calibration.camera))
    return load_pulses(config) if check_source else config


def load_pulses(config: SecondConfig) -> SecondConfig:
    """The configuration with the pulses of its table, if there is one.  Raises :class:`ConfigError`."""
    name = config.settings.laser.pulses
    return config if name is None else replace(config, pulses=_pulses(config.path, name))


def read_laser(path: Path) -> LaserCalibration:
    """A laser calibration.  Raises :class:`ConfigError`."""
    calibration = read_document(path, LaserCalibration)
    try:
        make_camera(calibration.camera)
        # The consistency of its numbers is checked where they are used.
        PulsedWatch(calibration, SpotWatchSettings(), PulseSettings())
    except (CalibrationError, ValueError) as error:
        raise ConfigError(path, "", str(error)) from None
    return calibration


def _pulses(path: Path, name: str) -> tuple[ReportedPulse, ...]:
    try:
        return tuple(read_pulses(path.parent / name))
    except InputError as error:
        wrong, _, right = str(error).rpartition("; ")
        raise ConfigError(path, "laser.pulses", wrong, right) from None


def _refuse_wrist(path: Path, values: dict[str, Any]) -> None:
    """Refuse keys of a wrist camera, with which it is ambiguous."""
    both = [key for key in _OF_A_WRIST if key in values]
    if both:
        right = f"{SECTION} for a second camera, or {both[0]} for a wrist camera; two cameras are two files"
        raise ConfigError(path, both[0], f"stands beside {SECTION}", right)
    if "camera" in values:
        raise ConfigError(path, "camera", f"stands beside {SECTION}", "nothing: the laser calibration's is used")


def _fault_between(settings: SecondSettings) -> Fault | None:
    """Frames and pulses must be both recorded or both live."""
    source, pulses = settings.source, settings.laser.pulses
    if isinstance(source, SimulatedSettings):
        return Fault("source.kind", "is simulator, which shows a gripper and no laser", "folder, video, live or zenoh")
    recorded = isinstance(source, FolderSettings | VideoSettings | EpisodeSettings)
    if recorded and pulses is None:
        return Fault("laser.pulses", "is missing", "a table of the recorded pulses: stamp_ns, until_ns, base_T_ee")
    if not recorded and pulses is not None:
        right = "leave it out: the robot's program reports each pulse on the key …/pulse"
        return Fault("laser.pulses", "has no effect with a live camera", right)
    if not recorded and not settings.publish.enabled:
        right = "publish.enabled: true, for the pulses come over the network"
        return Fault("publish.enabled", "is false, and the source is a live camera", right)
    return None
