"""A ROS 2 node on a Zenoh session: its tokens in the graph, its publishers.

Source: ``docs/design.md`` of ``rmw_zenoh`` (sections "Graph Cache" and "Publishers") and its
``rmw_publisher_data.cpp``, ``liveliness_utils.cpp`` (how a token becomes a gid) and ``attachment_helpers.cpp``.
"""

from __future__ import annotations

import itertools
import struct
import time
from typing import TYPE_CHECKING

from gripmon.io.ros2.names import DEFAULT_QOS, EndpointKind, NodeName, Qos, endpoint_token, node_token, topic_key
from gripmon.io.ros2.types import type_hash, typestore

if TYPE_CHECKING:
    import zenoh

_ids = itertools.count()
"""Nodes, publishers and subscriptions of a session share one row of numbers; ours are unique in the process."""

_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


def gid_of(token: str) -> bytes:
    """The id by which others know an endpoint: XXH3 of its token, 128 bits, the low half first, little endian."""
    import xxhash

    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


def attachment(sequence_number: int, stamp_ns: int, gid: bytes) -> bytes:
    """What ``rmw_zenoh`` wants beside every message (33 bytes); it drops messages without."""
    return _ATTACHMENT.pack(sequence_number, stamp_ns, _GID_BYTES, gid)


class Node:
    """A node that ``ros2 node list`` shows while the session is open, with what it publishes and subscribes to."""

    def __init__(self, session: zenoh.Session, domain_id: int, name: NodeName) -> None:
        self.domain_id = domain_id
        self.name = name
        self._session = session
        self._zid = str(session.info.zid())
        self._id = next(_ids)
        token = node_token(domain_id, self._zid, self._id, name)
        self._tokens = [session.liveliness().declare_token(token)]

    def publisher(
        self,
        topic: str,
        type_name: str,
        qos: Qos = DEFAULT_QOS,
        *,
        priority: zenoh.Priority | None = None,
        express: bool = False,
    ) -> TopicPublisher:
        """Publish on a topic (its full name).  A message that a congested link can't take is dropped, not waited for:
        so does ``rmw_zenoh`` with every history but keep all.  ``priority`` is Zenoh's ``DATA`` by default.
        """
        import zenoh

        token = self.declare("MP", topic, type_name, qos)
        publisher = self._session.declare_publisher(
            topic_key(self.domain_id, topic, type_name, type_hash(type_name)),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA if priority is None else priority,
            express=express,
        )
        return TopicPublisher(publisher, type_name, gid_of(token))

    def declare(self, kind: EndpointKind, topic: str, type_name: str, qos: Qos = DEFAULT_QOS) -> str:
        """Show a publisher (``MP``) or subscription (``MS``) in the graph; returns its token.

        A subscriber works without, but ``ros2 topic info`` doesn't know it, and nodes that publish only while somebody
        listens wait for it.
        """
        ids = (self._id, next(_ids))
        token = endpoint_token(
            kind, self.domain_id, self._zid, ids, self.name, topic, type_name, type_hash(type_name), qos
        )
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token

    def close(self) -> None:
        """Leave the graph; what was declared first leaves last.  Calling it twice does nothing more."""
        while self._tokens:
            self._tokens.pop().undeclare()


class TopicPublisher:
    """Messages of one type on one topic."""

    def __init__(self, publisher: zenoh.Publisher, type_name: str, gid: bytes) -> None:
        self._publisher = publisher
        self._type_name = type_name
        self._gid = gid
        self._sequence_number = 0
        self._serialize = typestore().serialize_cdr

    def put(self, message: object) -> None:
        """Send a message of ``rosbags``' type.  Raises whatever ``rosbags`` or Zenoh have against it."""
        payload = bytes(self._serialize(message, self._type_name, little_endian=True))
        self._sequence_number += 1
        beside = attachment(self._sequence_number, time.time_ns(), self._gid)
        self._publisher.put(payload, attachment=beside)
