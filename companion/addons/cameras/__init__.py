"""Drivers of real cameras: RealSense, OAK-D, ROS 2 topics and recordings, custom drivers.

Opens a camera by the name of its driver and converts its images to the vehicle's camera.
Option: `--camera realsense`, `oak-d`, `ros2:/TOPIC`, `rosbag:PATH`, FILE.py:NAME of the companion.
Depends on: the extras `realsense`, `oak` and `ros2`.
Guide: docs/how-to/on-board.md.
"""

CAMERAS = {"driver": "companion.addons.cameras.drivers:open_driver"}
