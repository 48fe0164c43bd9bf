"""Topics that somebody here listens to, made known to ROS 2."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from gripmon.io.ros2.names import NodeName, Qos
from gripmon.io.ros2.node import Node
from gripmon.io.wire import Link

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

_SENSOR_DATA = Qos(depth=5, reliable=False)


class HeardTopic(NamedTuple):
    """A topic by its full name, and what is heard there."""

    domain_id: int
    topic: str
    type_name: str


class Listeners:
    """Shows a node with subscriptions in the graph of each domain; the subscribers themselves are others' affair.

    They would hear without.  But publishers of images look whether anybody listens, and publish nothing if nobody does
    (``image_transport``).
    """

    def __init__(self, link: Link, name: NodeName, topics: Sequence[HeardTopic]) -> None:
        """Raises :class:`gripmon.io.ros2.RosNameError` for a topic that ROS doesn't allow."""
        self._name = name
        self._topics = [each._replace(topic=name.expand(each.topic)) for each in topics]
        self._nodes: dict[int, Node] = {}
        link.attach(self._adopt, self._leave)

    def _adopt(self, session: zenoh.Session) -> None:
        try:
            for domain_id, topic, type_name in self._topics:
                if domain_id not in self._nodes:
                    self._nodes[domain_id] = Node(session, domain_id, self._name)
                self._nodes[domain_id].declare("MS", topic, type_name, _SENSOR_DATA)
        except Exception as error:  # noqa: BLE001  who listens hears nevertheless
            _log.warning("ROS 2 won't know that %s is listened to: %s", topic, error)
            self._leave()

    def _leave(self) -> None:
        while self._nodes:
            self._nodes.popitem()[1].close()
