"""The readers of other programs' files, given a file's bytes."""

from __future__ import annotations

from typing import Any

from gripmon.calibrate import camera_files, hand_eye_formats
from gripmon.calibrate.camera_files import ForeignCamera
from gripmon.calibrate.foreign import Document
from gripmon.calibrate.hand_eye_formats import ForeignHandEye


def read_camera(data: bytes, file: str, **options: Any) -> ForeignCamera:
    return camera_files.read_camera(Document(file, data), **options)


def read_hand_eye(data: bytes, file: str, **options: Any) -> ForeignHandEye | None:
    return hand_eye_formats.read_hand_eye(Document(file, data), **options)
