"""A recorder as configured, for either kind of camera."""

from __future__ import annotations

import datetime
from pathlib import Path

import msgspec

from gripmon.laser.setup import LaserCalibration
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import RecordedConfiguration, ReferenceRecord
from gripmon.record.write.feed import ProcessRecorder, Truth
from gripmon.record.write.recorder import NullRecorder, Recorder, SpotRecorder
from gripmon.record.write.settings import RecordingSettings
from gripmon.record.write.view import ViewSettings
from gripmon.record.write.wire import make_scene, make_spot_scene


def open_recorder(
    settings: RecordingSettings,
    *,
    robot: str,
    camera_name: str,
    camera: Camera,
    gripper: Gripper,
    reference: ReferenceRecord,
    directory: Path | None = None,
    name: str | None = None,
    truth_tcp_m: Truth | None = None,
    patience_s: float = 0.0,
    configuration: RecordedConfiguration | None = None,
    view: ViewSettings | None = None,
) -> Recorder:
    """A recorder as configured; files are ``directory/name-0001.rrd`` and on, never overwriting one.

    ``directory`` replaces the settings' one, ``name`` the default of robot, camera and time of day.  ``truth_tcp_m``,
    which a simulator can give, maps a frame's ``seq`` to the TCP's true position in the camera frame; its shift against
    the reference is drawn beside the estimated one.  It is called by another thread than the loop's.  ``patience_s`` is
    for input that can wait, such as a folder: so long may ``offer`` wait for room before it drops a frame.  A camera
    can't wait: 0.  ``configuration`` is written into every file.  With ``view`` viewers may connect and see what is
    recorded as it comes, also where nothing is recorded.  Raises OSError when the directory can't be made.
    """
    if not settings.enabled and view is None:
        return NullRecorder()
    folder = Path(settings.directory) if directory is None else directory
    if settings.enabled:
        folder.mkdir(parents=True, exist_ok=True)
    if name is None:
        name = f"{robot}-{camera_name}-{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}"
    where = str(folder.resolve())
    has_truth = truth_tcp_m is not None
    scene = make_scene(settings, where, name, robot, camera_name, camera, gripper, reference, has_truth, configuration)
    scene = msgspec.structs.replace(scene, view=view)
    return ProcessRecorder(scene, truth_tcp_m, patience_s)


def open_spot_recorder(
    settings: RecordingSettings,
    *,
    robot: str,
    camera_name: str,
    calibration: LaserCalibration,
    directory: Path | None = None,
    patience_s: float = 0.0,
    configuration: RecordedConfiguration | None = None,
    view: ViewSettings | None = None,
) -> SpotRecorder:
    """The same for a second camera: every pulse with its image."""
    if not settings.enabled and view is None:
        return NullRecorder()
    folder = Path(settings.directory) if directory is None else directory
    if settings.enabled:
        folder.mkdir(parents=True, exist_ok=True)
    name = f"{robot}-{camera_name}-{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}"
    every = msgspec.structs.replace(settings, image_every=1)
    scene = make_spot_scene(every, str(folder.resolve()), name, robot, camera_name, calibration, configuration)
    return ProcessRecorder(msgspec.structs.replace(scene, view=view), None, patience_s)
