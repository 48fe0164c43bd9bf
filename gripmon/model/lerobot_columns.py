"""The columns for extrinsics in a LeRobot dataset, the same for every writer."""

from __future__ import annotations

from typing import Any

POSE_NAMES = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
"""``cam_T_grip``: position (m), quaternion; all 0, which is not a rotation, where it is unknown."""


def extrinsics_names(camera: str) -> tuple[str, str]:
    """Feature names for a camera (``wrist``, or its feature ``observation.images.wrist``): the feature with
    ``cam_T_grip``, and its flag: 1 where it may be used.
    """
    name = camera.removeprefix("observation.").removeprefix("images.")
    return f"observation.extrinsics.{name}", f"observation.extrinsics_valid.{name}"


def extrinsics_features(camera: str) -> dict[str, dict[str, Any]]:
    """Both features as ``meta/info.json`` describes them.  Value names must be unique in the dataset, because LeRobot
    looks up the values of an observation by name.
    """
    pose, flag = extrinsics_names(camera)
    values = {pose: [f"{pose.removeprefix('observation.')}.{one}" for one in POSE_NAMES]}
    values[flag] = [flag.removeprefix("observation.")]
    return {key: {"dtype": "float32", "shape": [len(names)], "names": names} for key, names in values.items()}
