"""Message types, their hashes and CDR, all by ``rosbags``; it is imported when it is first needed."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TF = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
JOINT_STATE = "sensor_msgs/msg/JointState"


class Ros2Missing(ImportError):
    """The optional dependencies are not there; the text is ``what is wrong; what would be right``."""


@functools.cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy; those we use are the same, hash by hash, from Iron to Lyrical.

    Raises :class:`Ros2Missing`.
    """
    try:
        import xxhash  # noqa: F401  both come with the same extra: said at the start, not at the first node
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise Ros2Missing(f"needs the package {error.name}; pip install -e '.[ros2]' in gripmon's checkout") from error
    return get_typestore(Stores.ROS2_JAZZY)


@functools.cache
def type_hash(type_name: str) -> str:
    """``RIHS01_…`` of a type, as REP-2016 has it."""
    return typestore().hash_rihs01(type_name)


def prepare(*type_names: str) -> None:
    """Have the code for these types generated now, tens of milliseconds that no frame should wait for."""
    for type_name in type_names:
        typestore().get_msgdef(type_name)
        type_hash(type_name)
