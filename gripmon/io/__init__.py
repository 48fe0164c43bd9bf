"""What comes in and goes out: images, Zenoh, ROS 2, metrics."""
