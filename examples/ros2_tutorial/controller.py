"""Control as a ROS 2 node: a path (/tutorial/path) and /odom in, /cmd_vel out, at 20 Hz (pure pursuit)."""

import math
from itertools import pairwise

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node

AHEAD, SPEED, TURN, NEAR = 0.4, 0.3, 1.0, 0.1
"""m, m/s, rad/s, m"""


class Controller(Node):
    """Steers at the point of the path that lies so far ahead; sends zeros at its end."""

    def __init__(self):
        super().__init__("controller")
        self.path, self.pose = [], None
        self.twists = self.create_publisher(TwistStamped, "/cmd_vel", 10)
        self.create_subscription(Odometry, "/odom", self.on_odometry, 10)
        self.create_subscription(Path, "/tutorial/path", self.on_path, 10)
        self.create_timer(0.05, self.step)

    def on_odometry(self, message):
        position, q = message.pose.pose.position, message.pose.pose.orientation
        self.pose = position.x, position.y, 2.0 * math.atan2(q.z, q.w)

    def on_path(self, message):
        corners = [(one.pose.position.x, one.pose.position.y) for one in message.poses]
        self.path = corners[:1]
        for (x, y), (u, v) in pairwise(corners):  # a path may have its corners alone: every 5 cm
            parts = max(1, math.ceil(math.dist((x, y), (u, v)) / 0.05))
            self.path += [(x + (u - x) * k / parts, y + (v - y) * k / parts) for k in range(1, parts + 1)]

    def step(self):
        if self.pose is None or not self.path:
            return
        x, y, yaw = self.pose
        nearest = min(range(len(self.path)), key=lambda i: math.dist(self.path[i], (x, y)))
        ahead = next((p for p in self.path[nearest:] if math.dist(p, (x, y)) > AHEAD), self.path[-1])
        twist = TwistStamped()
        twist.header.stamp = self.get_clock().now().to_msg()
        if math.dist(self.path[-1], (x, y)) > NEAR:
            angle = math.remainder(math.atan2(ahead[1] - y, ahead[0] - x) - yaw, math.tau)
            twist.twist.linear.x = SPEED * max(0.0, math.cos(angle))
            twist.twist.angular.z = max(-TURN, min(TURN, 2.0 * angle))
        self.twists.publish(twist)


rclpy.init()
rclpy.spin(Controller())
