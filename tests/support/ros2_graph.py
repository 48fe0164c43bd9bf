"""ROS 2 of the monitor ``arm/wrist``, and what of its node is in the graph."""

from __future__ import annotations

import zenoh

from gripmon.io.ros2.names import Layout, Ros2Settings, layout_of

ON = Ros2Settings(enabled=True)


def layout(settings: Ros2Settings = ON) -> Layout:
    return layout_of(settings, "arm", "wrist")


def tokens(session: zenoh.Session) -> list[str]:
    return [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**", timeout=5.0) if reply.ok]
