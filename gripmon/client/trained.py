"""Check that the camera is where it was when a policy's training data were recorded."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gripmon.client.reading import Reading

if TYPE_CHECKING:
    from gripmon.model.records import Array


class CameraMoved(RuntimeError):
    """The evaluation must not start: the camera isn't where it was in training, or its pose is unknown."""


@dataclass(frozen=True)
class Comparison:
    """The camera now relative to its nearest pose in training: shift of the TCP (m), turn (rad), and the bound on the
    present position error (m; None: the monitor states none).
    """

    shift_m: float
    turn_rad: float
    protection_m: float | None


def usable_poses(poses: Array, flags: Array) -> Array:
    """The usable transforms (m, 7) in the columns ``observation.extrinsics.<camera>`` (n, 7) and
    ``observation.extrinsics_valid.<camera>`` (n,) or (n, 1).  Raises ValueError if there is none.
    """
    import numpy as np

    poses, flags = np.asarray(poses, float).reshape(-1, 7), np.asarray(flags, float).reshape(-1)
    usable = poses[(flags == 1.0) & (np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1.0) < 1e-3)]
    if not len(usable):
        raise ValueError(f"of {len(poses)} frames of the training none has a valid transform; a dataset that has some")
    return usable


def compared(reading: Reading, trained: Array) -> Comparison:
    """Compare with the transforms of :func:`usable_poses`, of which the nearest has the smallest shift.  Raises
    ValueError for a reading without a transform.
    """
    import numpy as np

    if reading.transform is None:
        raise ValueError(reading.reason)
    shifts_m = np.linalg.norm(trained[:, :3] - np.array(reading.transform.translation_m), axis=1)
    nearest = int(np.argmin(shifts_m))
    now, then = np.array(reading.transform.rotation_xyzw), trained[nearest, 3:] / np.linalg.norm(trained[nearest, 3:])
    # Half the angle between unit quaternions (q and -q are the same rotation); exact for small turns, too.
    chord = min(float(np.linalg.norm(now - then)), float(np.linalg.norm(now + then)))
    half_rad = 2.0 * math.asin(min(chord / 2.0, 1.0))
    bound = None if reading.protection is None else reading.protection.position_m
    return Comparison(float(shifts_m[nearest]), 2.0 * half_rad, bound)


def require_same_camera(
    read: Callable[[], Reading], trained: Array, *, limit_m: float, limit_rad: float, wait_s: float = 10.0
) -> Comparison:
    """Return once a usable reading shows the camera within both limits of its pose in at least one training frame.
    ``read`` is called repeatedly until its reading is usable.

    Raises :class:`CameraMoved` if the camera is farther away, or if no usable reading came within ``wait_s``;
    ValueError for limits that are not positive numbers.
    """
    for name, value in (("limit_m", limit_m), ("limit_rad", limit_rad)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value!r}; a number above 0")
    end_s = time.monotonic() + wait_s
    while not (reading := read()).usable:
        if time.monotonic() >= end_s:
            raise CameraMoved(
                f"nothing shows where the camera is ({reading.reason}); a monitor whose transform is valid"
            )
        time.sleep(0.02)
    found = compared(reading, trained)
    if found.shift_m <= limit_m and found.turn_rad <= limit_rad:
        return found
    bound = "" if found.protection_m is None else f", known within {1e3 * found.protection_m:.2f} mm"
    raise CameraMoved(
        f"the camera has moved since training by {1e3 * found.shift_m:.2f} mm and {math.degrees(found.turn_rad):.2f}°"
        f"{bound}; at most {1e3 * limit_m:.2f} mm and {math.degrees(limit_rad):.2f}° were asked for: put it back, or "
        "train with the new place"
    )


def columns(poses: Sequence[float] | None, *, usable: bool) -> list[float]:
    """Eight numbers of an observation: the transform (all 0 if there is none) and the flag."""
    return [*(poses or [0.0] * 7), float(usable and poses is not None)]


def transform_of(reading: Reading) -> list[float] | None:
    """``cam_T_grip`` as in the columns: position (m), quaternion x, y, z, w."""
    if reading.transform is None:
        return None
    return [*reading.transform.translation_m, *reading.transform.rotation_xyzw]


def columns_of(dataset: Any, names: tuple[str, str]) -> tuple[Array, Array]:
    """Both columns of a ``lerobot`` dataset, whole.  Raises ValueError if one is missing."""
    import numpy as np

    absent = [name for name in names if name not in dataset.meta.features]
    if absent:
        right = "one recorded with gripmon's step, or the copy that docs/examples/lerobot_extrinsics.py makes"
        raise ValueError(f"{dataset.repo_id} has no column {absent[0]}; {right}")
    # Read the plain table: the dataset's own access would also decode the videos.
    table = dataset.hf_dataset.with_format("numpy").select_columns(list(names))[:]
    return np.stack(table[names[0]]), np.asarray(table[names[1]])
