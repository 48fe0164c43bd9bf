"""Poses of an arm with those of a target that a camera saw at each: read from tables, and from the images they name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gripmon.calibrate.detection import detect
from gripmon.calibrate.detection.boards import upright
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.robot_world import check_target_scale
from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
from gripmon.calibrate.tables import Row, check_scale, pose_of, rows_of
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
from gripmon.model.images import check_size, image_in
from gripmon.model.progress import Progress, quiet
from gripmon.model.records import Array, Image
from gripmon.model.targets import Chequerboard, Target, TargetError, name_of, tells_its_turn


@dataclass(frozen=True, slots=True)
class ArmPoses:
    """``base_T_ee`` and ``cam_T_target`` (n, 4, 4) with ``names``; ``covariance`` (n, 6, 6) of the targets' poses where
    they were seen in images, which ``images`` are; ``unseen``: where the target wasn't found, and why.
    """

    names: tuple[str, ...]
    base_T_ee: Array
    cam_T_target: Array
    covariance: Array | None = None
    images: tuple[Path, ...] = ()
    unseen: tuple[str, ...] = ()


@dataclass(slots=True)
class _Found:
    names: list[str] = field(default_factory=list)
    arm: list[Array] = field(default_factory=list)
    target: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)


def read_arm_poses(
    tables: Sequence[Path], camera: LensSettings | None = None, target: Target | None = None, progress: Progress = quiet
) -> ArmPoses:
    """All rows of all tables; for rows that name images the ``camera`` that took them and the ``target``.

    :class:`~gripmon.model.errors.InputError` for wrong tables, :class:`CalibrationError` where no image shows the
    target.
    """
    found = _Found()
    for path in tables:
        rows, places = rows_of(path)
        with progress(len(rows), "pose") as step:
            for row, place in zip(rows, places, strict=True):
                step()
                try:
                    _take(found, path, row, place, camera, target)
                except InputError:
                    raise
                except ValueError as error:
                    raise InputError(f"{path}: {error}") from None
    if not found.arm:
        raise CalibrationError(f"none of {len(found.unseen)} images shows the target", found.unseen)
    if found.covariances and len(found.covariances) < len(found.arm):
        raise InputError(f"{tables[0]}: some rows have cam_ columns, others images; one or the other")
    arm, targets = np.stack(found.arm), np.stack(found.target)
    try:
        check_scale(arm)
        check_target_scale(targets)
        _check_once(arm, targets, found.names)
    except ValueError as error:
        raise InputError(f"{tables[0]}: {error}") from None
    covariance = np.stack(found.covariances) if found.covariances else None
    return ArmPoses(tuple(found.names), arm, targets, covariance, tuple(found.images), tuple(found.unseen))


def _take(found: _Found, table: Path, row: Row, place: str, camera: LensSettings | None, target: Target | None) -> None:
    hand = pose_of(row, place)
    own = {key.removeprefix("cam_"): value for key, value in row.items() if key.startswith("cam_")}
    if own:
        found.target.append(pose_of(own, f"{place}, cam_"))
    else:
        if not row.get("image"):
            raise ValueError(f"{place}: has neither cam_tx_m … nor image; the target's pose, or an image of it")
        if camera is None or target is None:
            raise InputError("images need --camera and --target; both of them")
        path = table.parent / str(row["image"])
        found.images.append(path)
        image = image_in(path)
        check_size(str(path), image, camera.width_px, camera.height_px)
        try:
            pose, covariance = target_pose(image, camera, target, str(path))
        except CalibrationError as error:
            found.unseen.append(f"{path}: {error}")
            return
        found.target.append(pose)
        found.covariances.append(covariance)
    found.arm.append(hand)
    found.names.append(f"{table.name}, {place}")


def target_pose(image: Image, camera: LensSettings, target: Target, name: str = "") -> tuple[Array, Array]:
    """``cam_T_target`` (4, 4) and its covariance (6, 6), of a target that tells which way up it is (else
    :class:`~gripmon.model.targets.TargetError`).  :class:`CalibrationError` for an image that doesn't show it.
    """
    if not tells_its_turn(target):
        raise TargetError(
            f"{name_of(target)}: an image of it doesn't tell which way up it is, so any pose may be turned by half; a "
            "charuco board, or a chequerboard with one even, one odd number of corners"
        )
    sight = detect(image, target, name)
    if isinstance(sight, Sighting) and isinstance(target, Chequerboard):
        sight = upright(image, sight, target)
    if isinstance(sight, NotFound):
        raise CalibrationError(sight.reason)
    pose, covariance, _ = plate_pose(camera, sight)
    return pose, covariance


def _check_once(arm: Array, target: Array, names: Sequence[str]) -> None:
    """The same pose twice would make every uncertainty too small."""
    seen: dict[tuple[float, ...], str] = {}
    for hand, plate, name in zip(arm, target, names, strict=True):
        key = tuple(np.round(np.concatenate([hand.ravel(), plate.ravel()]), 9).tolist())
        first = seen.setdefault(key, name)
        if first is not name:
            raise ValueError(f"{name}: is the same pose as {first}; each pose once")
