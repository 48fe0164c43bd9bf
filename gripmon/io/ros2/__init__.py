"""ROS 2 by ``rclpy``: the robot's own, whatever its middleware, or the wheels of ``gripmon[ros2]``.

It is imported late, and runs in threads of this process.
"""
