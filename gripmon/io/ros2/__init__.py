"""ROS 2 without a bridge: what a node on ``rmw_zenoh`` would put on the network, and reading what such nodes put there.

The message definitions, their hashes and CDR come from ``rosbags``, an optional dependency (``gripmon[ros2]``) that is
imported at the first message.
"""
