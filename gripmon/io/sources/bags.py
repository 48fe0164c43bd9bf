"""Recorded messages: an MCAP file, a .db3 or a folder of rosbag2, or a .bag of ROS 1, with images, joint states and
camera calibrations.

CDR and ROS 1's messages are decoded by ``rosbags``, Protobuf by ``mcap-protobuf-support``, from the schema in the file;
JSON as Foxglove writes it.  Sources: the MCAP specification, Foxglove's schemas, ``sensor_msgs``.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from gripmon.io.sources.base import SourceError, Stored
from gripmon.io.sources.camera_info import is_rectified, lens_of
from gripmon.io.sources.payload import PayloadError, message_image
from gripmon.io.sources.stamps import Stamped, rising
from gripmon.io.sources.stored import (
    VideoDecoder,
    file_system,
    joined,
    needed,
    opened,
    openings_at,
    there,
)
from gripmon.model.camera import LensSettings
from gripmon.model.errors import one_line
from gripmon.model.images import NOT_AN_IMAGE, grey_image
from gripmon.model.jaw import JointOpening
from gripmon.model.pixels import without_mosaic
from gripmon.model.records import Array, Frame, Image

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
_IMAGES = ("Image", "RawImage", "CompressedImage", "CompressedVideo")
_CAMERAS = ("CameraInfo", "CameraCalibration")
_JOINTS = ("JointState",)


class BagSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="bag"):
    """An MCAP file or a rosbag: frames with their stamps, and openings from joint states."""

    path: Annotated[
        str, msgspec.Meta(min_length=1, description="the .mcap, .db3 or .bag file, or the folder with metadata.yaml")
    ]
    camera: (
        Annotated[str, msgspec.Meta(min_length=1, description="topic of the images; absent: the only one")] | None
    ) = None
    opening: JointOpening | None = None


class _Message(NamedTuple):
    topic: str
    kind: str
    """The type's last part: CompressedImage of sensor_msgs and of foxglove alike."""
    log_ns: int
    decode: Callable[[], Any]


class _CutShort(Exception):
    """The file is truncated or damaged; ``str()`` says how."""


class _Mcap:
    """An MCAP file, whole or truncated: without its summary it is read from the beginning as far as possible."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._reader = needed("mcap.reader")
        with opened(path) as stream:
            try:
                summary = self._reader.SeekingReader(stream).get_summary()
            except Exception:  # noqa: BLE001  a dozen types, by what is damaged
                summary = None
        self.whole = summary is not None and summary.statistics is not None
        if self.whole:
            self.types = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values() if c.schema_id}
            return
        self.types = {}
        try:
            for schema, channel, _ in self._records(None):
                self.types.setdefault(channel.topic, "" if schema is None else schema.name)
        except _CutShort as error:
            if not self.types:
                raise SourceError(f"path: {path} can't be read ({error}); a whole .mcap file") from None

    def messages(self, topics: list[str]) -> Iterator[_Message]:
        """Messages in order of their log times; of a truncated file in the file's order."""
        for schema, channel, message in self._records(topics):
            decode = functools.partial(self._decode, message.data, channel.message_encoding, schema)
            yield _Message(channel.topic, _kind(schema.name), message.log_time, decode)
        if not self.whole:
            raise _CutShort("it has no summary")

    def _decode(self, data: bytes, encoding: str, schema: Any) -> Any:
        """A decoded message, its fields as attributes.  ValueError for an unsupported encoding."""
        if encoding in _OF_ROS:
            return _of_ros(data, encoding, schema.name, schema.data.decode(errors="replace"))
        if encoding == "protobuf":
            return self._protobuf.decoder_for(encoding, schema)(data)
        if encoding == "json":
            return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
        raise ValueError(f"a message in {encoding}; cdr, ros1, protobuf or json")

    @functools.cached_property
    def _protobuf(self) -> Any:
        return needed("mcap_protobuf.decoder").DecoderFactory()

    def _records(self, topics: list[str] | None) -> Iterator[Any]:
        with opened(self._path) as stream:
            reader = (self._reader.SeekingReader if self.whole else self._reader.NonSeekingReader)(stream, True)
            found = reader.iter_messages(topics=topics, log_time_order=self.whole)
            while True:
                try:
                    record = next(found, None)
                except Exception as error:  # noqa: BLE001  as above
                    raise _CutShort(one_line(error)[:200]) from None
                if record is None:
                    return
                yield record


_OF_ROS = {"cdr": "ROS2_JAZZY", "ros1": "ROS1_NOETIC"}
"""Encodings, and whose types of messages are known beforehand; those we use are the same from Iron to Lyrical."""


@functools.lru_cache(maxsize=64)
def _types(encoding: str, name: str, definition: str) -> Any:
    """A store that knows one type as its own recording defines it: another may mean something else by its name.  Raises
    :class:`SourceError`.
    """
    typesys = needed("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores[_OF_ROS[encoding]])
    if name not in store.types:
        store.register(typesys.get_types_from_msg(definition, name))
    return store


def _kind(type_name: str) -> str:
    return type_name.replace(".", "/").rpartition("/")[2]


def _of_ros(data: bytes, encoding: str, type_name: str, definition: str) -> Any:
    name = type_name if "/msg/" in type_name else type_name.replace("/", "/msg/")
    store = _types(encoding, name, definition)
    return store.deserialize_cdr(data, name) if encoding == "cdr" else store.deserialize_ros1(data, name)


class _Rosbag:
    """A folder of rosbag2 with SQLite or MCAP files, a bare .db3, or a .bag of ROS 1, on this machine."""

    whole = True

    def __init__(self, path: str) -> None:
        self._encoding = "ros1" if path.lower().endswith(".bag") else "cdr"
        Reader = needed(f"rosbags.rosbag{'1' if self._encoding == 'ros1' else '2'}").Reader
        system, inside = file_system(path)
        if "file" not in (system.protocol if isinstance(system.protocol, tuple) else (system.protocol,)):
            raise SourceError(f"path: {path}: rosbags are read on this machine only; .mcap files, or a copy")
        self._path, self._reader = Path(inside), Reader
        try:
            with Reader(self._path) as reader:
                self.types = {connection.topic: connection.msgtype for connection in reader.connections}
        except Exception as error:  # noqa: BLE001  a dozen types, by what is damaged
            raise SourceError(f"path: {path} can't be read ({one_line(error):.200}); a whole rosbag") from None

    def messages(self, topics: list[str]) -> Iterator[_Message]:
        """Messages in order of their log times."""
        try:
            with self._reader(self._path) as reader:
                wanted = [connection for connection in reader.connections if connection.topic in topics]
                for connection, log_ns, data in reader.messages(connections=wanted):
                    name, definition = connection.msgtype, connection.msgdef.data
                    decode = functools.partial(_of_ros, data, self._encoding, name, definition)
                    yield _Message(connection.topic, _kind(name), log_ns, decode)
        except Exception as error:  # noqa: BLE001  as above
            raise _CutShort(one_line(error)[:200]) from None


def open_messages(path: str) -> _Mcap | _Rosbag:
    """The messages of a file or folder.  Raises :class:`SourceError`."""
    return _Mcap(path) if path.lower().endswith(".mcap") else _Rosbag(path)


def is_rosbag2(path: str) -> bool:
    """Whether a folder is a rosbag2."""
    return there(joined(path, "metadata.yaml"))


class BagSource(Stored):
    """Every image of a topic, in order of log time, with the stamp of its own header (if that is empty, the log's),
    and the opening at that time.  A frame with a wrong stamp has no image, but a fault (:func:`rising`); so has the
    last one of a truncated file.

    ``topic``: that of the images.  Raises :class:`SourceError` for unreadable files, and for a missing topic or joints,
    with the names of the existing ones.
    """

    def __init__(self, settings: BagSettings, relative_to: str = "") -> None:
        self._path = settings.path if "://" in settings.path else joined(relative_to, settings.path)
        self._bag = open_messages(self._path)
        self.topic = self._chosen(settings.camera)
        self._stamps_ns, self._openings_m = self._joints(settings.opening)
        self._decoder: VideoDecoder | None = None
        self._open = True
        self._frames = self._read()

    @functools.cached_property
    def camera(self) -> LensSettings | None:
        """The images' calibration in the file: of the topic nearest by name; None if there is none, or several.

        Raises :class:`SourceError` for one that can't be used: only when it is asked for.
        """
        topics = self._topics(_CAMERAS)
        parent = self.topic
        near: list[str] = []
        while parent and not near:
            parent = parent.rpartition("/")[0]
            near = [topic for topic in topics if topic.startswith(f"{parent}/")]
        if len(near or topics) != 1:
            return None
        try:
            message = next(self._bag.messages(near or topics), None)
            return None if message is None else lens_of(message.decode(), rectified=is_rectified(self.topic))
        except Exception as error:  # noqa: BLE001  each library's own
            raise SourceError(f"camera: {self._path}: {(near or topics)[0]}: {one_line(error)}") from None

    def read(self) -> Frame | None:
        return next(self._frames, None) if self._open else None

    def close(self) -> None:
        self._open = False

    def _topics(self, kinds: tuple[str, ...]) -> list[str]:
        return sorted(topic for topic, name in self._bag.types.items() if _kind(name) in kinds)

    def _chosen(self, wanted: str | None) -> str:
        topics = self._topics(_IMAGES)
        if wanted in topics:
            return str(wanted)
        there = ", ".join(topics)
        if not topics:
            others = ", ".join(f"{topic} ({name})" for topic, name in sorted(self._bag.types.items()))
            wrong = f"camera: {self._path} has no topic with images ({', '.join(_IMAGES)})"
            raise SourceError(f"{wrong}; its topics: {others or 'none'}")
        if wanted is not None:
            raise SourceError(f"camera: {self._path} has no images on {wanted}; one of its topics with images: {there}")
        if len(topics) != 1:
            raise SourceError(f"camera: {self._path} has several topics with images; one of: {there}")
        return topics[0]

    def _joints(self, opening: JointOpening | None) -> tuple[np.ndarray, Array]:
        """Stamps (n,) and openings (n,) of all reports, in order of time."""
        if opening is None:
            return np.empty(0, np.int64), np.empty(0)
        reports: dict[str, list[tuple[float, Stamped]]] = {}  # by topic: two may say the same
        names, topics, refused = set[str](), self._topics(_JOINTS), ""
        with contextlib.suppress(_CutShort):  # the images end there, too, and report it
            for message in self._bag.messages(topics) if topics else ():
                try:
                    found = message.decode()
                    names.update(found.name)
                    opening_m = opening.opening_m(dict(zip(found.name, map(float, found.position), strict=False)))
                    stamped = Stamped(_stamp_ns(found) or message.log_ns, message.log_ns)
                except _CutShort:
                    raise
                except Exception as error:  # noqa: BLE001  each library's own; one bad message costs itself
                    refused = refused or one_line(error)
                    continue
                if opening_m is not None:
                    reports.setdefault(message.topic, []).append((opening_m, stamped))
        if refused and not reports:
            raise SourceError(f"opening: {self._path}: {refused}")
        if not reports:
            there = ", ".join(sorted(names)) or "none"
            wanted = ", ".join(opening.joints)
            raise SourceError(f"opening.joints: {self._path} has no joint state of {wanted}; of its joints: {there}")
        told = (each for of_topic in reports.values() for each in rising(of_topic))
        sound = sorted((stamp_ns, opening_m) for opening_m, stamp_ns, fault in told if fault is None)
        return np.array([stamp for stamp, _ in sound], np.int64), np.array([opening for _, opening in sound])

    def _read(self) -> Iterator[Frame]:
        seq, stamp_ns = 0, 0
        cut: list[str] = []
        for (found, kind, fault), stamp_ns, wrong in rising(self._stamped(cut)):
            image = None
            if fault is None:  # of a video the next ones need it, too
                image, fault = self._image(found, kind)
            image, fault = (image, fault) if wrong is None else (None, wrong)
            opening_m = openings_at(self._stamps_ns, self._openings_m, stamp_ns) if len(self._stamps_ns) else None
            yield Frame(seq, stamp_ns, image, opening_m, self.topic, fault)
            seq += 1
        for why in cut:
            fault = f"{self._path} is cut short or damaged after {seq} frames ({why})"
            yield Frame(seq, stamp_ns, None, None, self.topic, fault)

    def _stamped(self, cut: list[str]) -> Iterator[tuple[tuple[Any, str, str | None], Stamped]]:
        """Each message, its kind, why it can't be decoded; ``cut`` gets the reason if the file isn't whole."""
        try:
            for message in self._bag.messages([self.topic]):
                found, fault, stamp_ns = None, None, message.log_ns
                try:
                    found = message.decode()
                    stamp_ns = _stamp_ns(found) or stamp_ns
                except Exception as error:  # noqa: BLE001  whatever a damaged message does, the others are sound
                    fault = f"the message can't be decoded ({one_line(error):.200})"
                yield (found, message.kind, fault), Stamped(stamp_ns, message.log_ns)
        except _CutShort as error:
            cut.append(str(error))

    def _image(self, message: Any, kind: str) -> tuple[Image | None, str | None]:
        try:
            data = base64.b64decode(message.data) if isinstance(message.data, str) else bytes(message.data)
            said = str(getattr(message, "format", None) or "")
            if kind == "CompressedVideo" or (kind == "CompressedImage" and VideoDecoder.knows(said)):
                self._decoder = self._decoder or VideoDecoder(said)
                return self._decoder.decode(data)
            if kind == "CompressedImage":
                image, fault = grey_image(data)
                if fault == NOT_AN_IMAGE:
                    fault = f"{fault}: format {said!r:.60}; JPEG, PNG, WebP or {VideoDecoder.NAMES}"
                return (image if image is None else without_mosaic(image, data, said)), fault
            return message_image(message, data, (int(message.width), int(message.height))), None
        except PayloadError as error:
            return None, str(error)
        except Exception as error:  # noqa: BLE001  as above
            return None, f"the message can't be decoded ({one_line(error):.200})"


def _stamp_ns(message: Any) -> int:
    """Stamp of the message's own header; 0 if it has none or an empty one."""
    stamp = getattr(getattr(message, "header", message), "stamp", None) or getattr(message, "timestamp", None)
    if stamp is None:
        return 0
    # As ROS names them, Foxglove's JSON, and Protobuf.
    seconds = max(getattr(stamp, name, 0) for name in ("sec", "seconds"))
    return int(seconds) * 1_000_000_000 + int(max(getattr(stamp, name, 0) for name in ("nanosec", "nsec", "nanos")))
