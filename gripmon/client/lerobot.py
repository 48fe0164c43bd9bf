"""For LeRobot (the package ``lerobot``, 0.4): extrinsics and a validity flag as observations while recording, and a
check before an evaluation that the camera has not moved since.

A LeRobot process receives a monitor's transforms over Zenoh, and may send it the images of a camera that LeRobot itself
has open.  The monitor runs in its own environment, as the two packages need different versions of others.  Besides
LeRobot, this module needs only ``eclipse-zenoh`` and ``msgspec``.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

from gripmon.client.reading import Reading
from gripmon.client.trained import (
    CameraMoved,
    Comparison,
    columns,
    columns_of,
    require_same_camera,
    transform_of,
    usable_poses,
)
from gripmon.client.transforms import TransformClient
from gripmon.io.wire import DEFAULT_ENDPOINT, Keys, Link, PublishSettings
from gripmon.model.lerobot_columns import extrinsics_features
from gripmon.model.records import FrameNote, to_json

__all__ = ["CameraMoved", "Comparison", "ExtrinsicsStep", "JawOpening", "trained_poses"]


@dataclass
class JawOpening:
    """metres = offset_m + scale_m * observation[joint]"""

    joint: str
    scale_m: float
    offset_m: float = 0.0


@ProcessorStepRegistry.register(name="gripmon_extrinsics")
@dataclass
class ExtrinsicsStep(ObservationProcessorStep):  # type: ignore[misc]
    """Adds the transform of the monitor of ``robot`` and ``camera`` to each observation: the numbers of
    ``observation.extrinsics.<camera>`` (``cam_T_grip``: m, quaternion x, y, z, w; all 0 if unknown) and of
    ``observation.extrinsics_valid.<camera>`` (1 if it may be used).

    Put it into the ``robot_observation_processor``, and ``dataset_features`` among the features with which the dataset
    is created.  ``feed``: the image ``observation[camera]`` (H x W x 3, RGB, uint8) is sent to the monitor, whose
    source is then ``kind: zenoh``; the transform is that of the same image, waited for at most ``wait_s``; without an
    answer by then the flag is 0.  Otherwise the monitor has the camera open, and its newest transform is used.
    ``opening`` computes the jaw opening that is sent with each image.  :meth:`close` leaves the network.

    Raises KeyError for an observation without the image or the joint.
    """

    robot: str
    camera: str = "wrist"
    connect: list[str] = field(default_factory=lambda: [DEFAULT_ENDPOINT])
    feed: bool = False
    opening: JawOpening | dict[str, Any] | None = None
    wait_s: float = 0.05

    def __post_init__(self) -> None:
        # A pipeline that was saved as JSON has a dict here.
        self._opening = JawOpening(**self.opening) if isinstance(self.opening, dict) else self.opening
        self._names = [name for one in self.dataset_features.values() for name in one["names"]]
        self._monitor = TransformClient(self.robot, self.camera, connect=self.connect)
        self._link: Link | None = None
        self._publisher: zenoh.Publisher | None = None
        if self.feed:
            self._link = Link(PublishSettings(listen=(), connect=tuple(self.connect)))
            self._link.attach(self._declare)

    @property
    def dataset_features(self) -> dict[str, dict[str, Any]]:
        """The two columns, as LeRobot describes features."""
        return {name: one | {"shape": tuple(one["shape"])} for name, one in extrinsics_features(self.camera).items()}

    def read(self, observation: dict[str, Any]) -> Reading:
        """The monitor's transform for an observation, and whether it may be used."""
        if not self.feed:
            return self._monitor.latest()
        stamp_ns = self._send(observation)
        end_s = time.monotonic() + self.wait_s
        while (reading := self._monitor.latest()).stamp_ns < stamp_ns and time.monotonic() < end_s:
            time.sleep(0.001)
        return reading if reading.stamp_ns >= stamp_ns else _late(reading, self.wait_s)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        reading = self.read(observation)
        values = columns(transform_of(reading), usable=reading.usable)
        return observation | dict(zip(self._names, values, strict=True))

    def require_same_camera(
        self, robot: Any, trained: Any, *, limit_mm: float, limit_deg: float, wait_s: float = 10.0
    ) -> Comparison:
        """Before an evaluation: returns if the camera is within both limits of its pose in a frame of ``trained``
        (:func:`trained_poses`).  ``robot``: LeRobot's, connected; with ``feed`` its observations are sent.

        Raises :class:`CameraMoved` if it isn't, or if no valid transform comes within ``wait_s``.
        """
        limits = {"limit_m": 1e-3 * limit_mm, "limit_rad": float(np.radians(limit_deg)), "wait_s": wait_s}

        def read() -> Reading:
            return self.read(robot.get_observation() if self.feed else {})

        return require_same_camera(read, trained, **limits)

    def close(self) -> None:
        """Leave the network.  Calling it twice does nothing more."""
        self._monitor.close()
        if self._link is not None:
            self._link.close()

    def get_config(self) -> dict[str, Any]:
        opening = None if self._opening is None else vars(self._opening)
        names = ("robot", "camera", "connect", "feed", "wait_s")
        return {name: getattr(self, name) for name in names} | {"opening": opening}

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        """Unchanged: LeRobot would put numbers into ``observation.state``, from which policies learn."""
        return features

    def _declare(self, session: zenoh.Session) -> None:
        self._publisher = session.declare_publisher(Keys(self.robot, self.camera)["image"])

    def _send(self, observation: dict[str, Any]) -> int:
        """Send the image; returns its stamp (Unix ns)."""
        image = np.ascontiguousarray(observation[self.camera])
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"observation[{self.camera!r}] is {image.dtype} {image.shape}; H x W x 3, RGB, uint8")
        opening = self._opening
        opening_m = None if opening is None else opening.offset_m + opening.scale_m * float(observation[opening.joint])
        note = FrameNote(
            stamp_ns=time.time_ns(), jaw_opening_m=opening_m, width=image.shape[1], height=image.shape[0],
            encoding="rgb8",
        )  # fmt: skip
        if self._publisher is not None:
            with contextlib.suppress(zenoh.ZError):  # the session is being opened again
                self._publisher.put(image.tobytes(), attachment=to_json(note))
        assert note.stamp_ns is not None
        return note.stamp_ns


def _late(reading: Reading, wait_s: float) -> Reading:
    import msgspec

    reason = reading.reason or f"the monitor hasn't answered to the image within {wait_s:g} s"
    return msgspec.structs.replace(reading, usable=False, reason=reason)


def trained_poses(dataset: Any, camera: str = "wrist") -> Any:
    """The transforms (n, 7) of a ``LeRobotDataset`` that may be used, for :meth:`ExtrinsicsStep.require_same_camera`.

    Raises ValueError for a dataset without the two columns, or without any valid transform.
    """
    pose, flag = extrinsics_features(camera)
    return usable_poses(*columns_of(dataset, (pose, flag)))
