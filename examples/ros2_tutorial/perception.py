"""Perception as a ROS 2 node: /scan and /odom in, a grid of what was seen out (/tutorial/map, in odom)."""

import math

import numpy as np
import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

CELL, CELLS = 0.05, 160
"""m; the grid is a square of 8 m about where the robot began."""
LIDAR_X = 0.12
"""m from base_link to the lidar, as /tf_static has it."""


class Perception(Node):
    """Marks the cell that each beam ends in, and forgets it slowly."""

    def __init__(self):
        super().__init__("perception")
        self.pose = None
        self.seen = np.zeros((CELLS, CELLS))
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.maps = self.create_publisher(OccupancyGrid, "/tutorial/map", kept)
        self.create_subscription(Odometry, "/odom", self.on_odometry, 10)
        self.create_subscription(LaserScan, "/scan", self.on_scan, qos_profile_sensor_data)

    def on_odometry(self, message):
        position, q = message.pose.pose.position, message.pose.pose.orientation
        self.pose = position.x, position.y, 2.0 * math.atan2(q.z, q.w)

    def on_scan(self, scan):
        if self.pose is None:
            return
        x, y, yaw = self.pose
        ranges = np.array(scan.ranges)
        angles = yaw + scan.angle_min + scan.angle_increment * np.arange(len(ranges))
        hit = np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges < scan.range_max)
        ends_x = x + LIDAR_X * math.cos(yaw) + ranges[hit] * np.cos(angles[hit])
        ends_y = y + LIDAR_X * math.sin(yaw) + ranges[hit] * np.sin(angles[hit])
        columns, rows = (np.floor(one / CELL).astype(int) + CELLS // 2 for one in (ends_x, ends_y))
        inside = (rows >= 0) & (rows < CELLS) & (columns >= 0) & (columns < CELLS)
        self.seen *= 0.9
        self.seen[rows[inside], columns[inside]] = 1.0
        grid = OccupancyGrid()
        grid.header.stamp, grid.header.frame_id = scan.header.stamp, "odom"
        grid.info.resolution, grid.info.width, grid.info.height = CELL, CELLS, CELLS
        grid.info.origin.position.x = grid.info.origin.position.y = -CELL * CELLS / 2
        grid.data = np.where(self.seen > 0.3, 100, 0).astype(np.int8).ravel().tolist()
        self.maps.publish(grid)


rclpy.init()
rclpy.spin(Perception())
