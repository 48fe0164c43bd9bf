"""The settings of one monitor, assembled from the sections that each package defines beside its algorithms."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.daemon.watch import DaemonSettings
from gripmon.io.metrics import MetricsSettings
from gripmon.io.ros2.settings import Ros2Settings
from gripmon.io.sources import SourceSettings
from gripmon.io.wire import PublishSettings
from gripmon.judge.statefile import StateSettings
from gripmon.model.camera import LensSettings
from gripmon.monitor import MonitorSettings
from gripmon.record.recorder import RecordingSettings, ViewSettings

Name = Annotated[
    str,
    Meta(
        pattern=r"^[^/*$#?@\s][^/*$#?\s]*$",
        description="part of the Zenoh keys gripmon/<robot>/<camera>/…: no blank, none of / * $ # ?, no @ in front",
    ),
]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class TransformSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``cam_T_grip``: where the gripper frame is in the camera frame."""

    translation_m: Annotated[Vector, Meta(description="the TCP in the camera frame: x right, y down, z forward (m)")]
    rotation_xyzw: Annotated[
        Quaternion, Meta(description="unit quaternion x, y, z, w of the gripper's axes in the camera frame")
    ]


class ReferenceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The calibration that drift is measured against."""

    cam_T_grip: TransformSettings
    id: Annotated[str, Meta(min_length=1, description="name of this calibration in messages")] | None = None
    position_sigma_m: (
        Annotated[
            float,
            Meta(
                gt=0.0,
                le=0.1,
                description="standard deviation of the reference's position, per axis; once edges are taught, in every "
                "absolute protection level; null: not known, 0.001 is assumed (m)",
            ),
        ]
        | None
    ) = None
    rotation_sigma_rad: (
        Annotated[
            float,
            Meta(
                gt=0.0,
                le=0.5,
                description="standard deviation of the reference's rotation, per axis, likewise; null: 0.01 is assumed "
                "(rad)",
            ),
        ]
        | None
    ) = None
    covariance: (
        Annotated[
            tuple[float, ...],
            Meta(
                min_length=36,
                max_length=36,
                description="6x6 row by row, position (m²) then rotation (rad²); replaces both sigmas",
            ),
        ]
        | None
    ) = None
    with_gripper: Annotated[
        bool,
        Meta(
            description="the gripper file was made of the same images: what it and this reference are off by together, "
            "in size and tilt, counts once"
        ),
    ] = False


class JawSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the jaw opening of a frame comes from."""

    source: Annotated[
        Literal["fixed", "frames", "zenoh"],
        Meta(
            description="fixed: opening_m; frames: comes with each frame (simulator, timestamps.csv, network, "
            "source.joint_states); zenoh: key …/jaw"
        ),
    ] = "fixed"
    opening_m: (
        Annotated[
            float,
            Meta(ge=0.0, le=0.5, description="jaw opening with source fixed; the gripper's nominal if absent (m)"),
        ]
        | None
    ) = None


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole configuration file."""

    robot: Name
    camera_name: Name
    camera: LensSettings
    gripper: Annotated[str, Meta(min_length=1, description="path of the gripper file, relative to this file")]
    reference: ReferenceSettings
    taught: (
        Annotated[
            str,
            Meta(min_length=1, description="file written by gripmon teach, its path relative to this file"),
        ]
        | None
    ) = None
    source: SourceSettings
    jaw: JawSettings = JawSettings()
    monitor: MonitorSettings = MonitorSettings()
    publish: PublishSettings = PublishSettings()
    ros2: Ros2Settings = Ros2Settings()
    recording: RecordingSettings = RecordingSettings()
    view: ViewSettings = ViewSettings()
    metrics: MetricsSettings = MetricsSettings()
    daemon: DaemonSettings = DaemonSettings()
    state: StateSettings = StateSettings()
