"""ROS 2 names, and the Zenoh keys that ``rmw_zenoh`` makes of them.

Source: the design document of ``rmw_zenoh`` (https://github.com/ros2/rmw_zenoh, ``docs/design.md``), sections "Topic
and Service name mapping to Zenoh key expressions" and "Graph Cache"; the text of a QoS is ``qos_to_keyexpr`` in its
``liveliness_utils.cpp``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

MOST_DOMAIN_ID = 232
"""As with every other ROS 2 middleware; Zenoh itself would take any number."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv)/([A-Z][A-Za-z0-9]*)")
_UNTOLD_DEPTH = 42  # what rmw_zenoh takes an unset depth for, and so leaves out

EndpointKind = Literal["MP", "MS"]


class RosNameError(ValueError):
    """A name that ROS 2 doesn't allow; the text says which and what would be right."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service, as far as we use it: always keep last, never a deadline."""

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False

    def __str__(self) -> str:
        """As in liveliness tokens, ``reliability:durability:history,depth:deadline:lifespan:liveliness``; what is
        ``rmw_zenoh``'s default stays empty.
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == _UNTOLD_DEPTH else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


DEFAULT_QOS = Qos()
"""ROS 2's default: reliable, volatile, keep last 10."""


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node and its namespace, which begins with ``/``."""

    name: str
    namespace: str = "/"

    def __post_init__(self) -> None:
        if not _TOKEN.fullmatch(self.name):
            raise RosNameError(f"node name {self.name!r}; give letters, digits and _, no digit in front")
        check_qualified("namespace", self.namespace, root=True)

    def expand(self, topic: str) -> str:
        """The full name of a topic: ``~/x`` is below the node, ``x`` below the namespace, ``/x`` stays."""
        base = self.namespace.rstrip("/")
        if topic.startswith("~/"):
            topic = f"{base}/{self.name}/{topic[2:]}"
        elif not topic.startswith("/"):
            topic = f"{base}/{topic}"
        return check_qualified("topic", topic)


def check_qualified(role: str, name: str, *, root: bool = False) -> str:
    """The name; raises :class:`RosNameError` unless it is ``/one/or/more`` tokens, or ``/`` itself if ``root``."""
    if root and name == "/":
        return name
    if not name.startswith("/") or not all(_TOKEN.fullmatch(token) for token in name[1:].split("/")):
        raise RosNameError(f"{role} {name!r}; give /tokens of letters, digits and _, no digit in front, e.g. /arm/tf")
    return name


def as_token(text: str) -> str:
    """A name of ours as one token of a ROS name: what isn't allowed there becomes ``_``."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return token if _TOKEN.fullmatch(token) else f"_{token}"


def dds_type(type_name: str) -> str:
    """``std_msgs/msg/String`` -> ``std_msgs::msg::dds_::String_``."""
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise RosNameError(f"type {type_name!r}; give package/msg/Type, e.g. sensor_msgs/msg/Image")
    return f"{match[1]}::{match[2]}::dds_::{match[3]}_"


def topic_key(domain_id: int, topic: str, type_name: str, type_hash: str) -> str:
    """Where messages are put: ``<domain>/<topic>/<type>/<hash>``."""
    return f"{check_domain(domain_id)}{check_qualified('topic', topic)}/{dds_type(type_name)}/{type_hash}"


def subscription_key(domain_id: int, topic: str, type_name: str) -> str:
    """Where messages of that type come from, whatever hash the publisher's distribution gives to the type.

    ``topic`` is a full name, ``/camera/image_raw``.  Raises :class:`RosNameError`.
    """
    return topic_key(domain_id, topic, type_name, "*")


def node_token(domain_id: int, zid: str, node_id: int, node: NodeName) -> str:
    """The liveliness token of a node, of which ``ros2 node list`` knows it."""
    return _token(domain_id, zid, node_id, node_id, "NN", node)


def endpoint_token(
    kind: EndpointKind,
    domain_id: int,
    zid: str,
    ids: tuple[int, int],
    node: NodeName,
    topic: str,
    type_name: str,
    type_hash: str,
    qos: Qos,
) -> str:
    """The liveliness token of a publisher (``MP``) or subscription (``MS``); ``ids`` are the node's and its own."""
    whose = _token(domain_id, zid, *ids, kind, node)
    return f"{whose}/{_mangled(check_qualified('topic', topic))}/{dds_type(type_name)}/{type_hash}/{qos}"


def check_domain(domain_id: int) -> int:
    """The domain; raises :class:`RosNameError` outside of 0 to 232."""
    if not 0 <= domain_id <= MOST_DOMAIN_ID:
        raise RosNameError(f"domain {domain_id}; give ROS_DOMAIN_ID, 0 to {MOST_DOMAIN_ID}")
    return domain_id


def _token(domain_id: int, zid: str, node_id: int, entity_id: int, kind: str, node: NodeName) -> str:
    enclave = "%"  # none: we don't take part in SROS 2
    where = f"{check_domain(domain_id)}/{zid}/{node_id}/{entity_id}"
    return f"@ros2_lv/{where}/{kind}/{enclave}/{_mangled(node.namespace)}/{node.name}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
