"""Input and output: image sources, Zenoh, ROS 2 and metrics."""
