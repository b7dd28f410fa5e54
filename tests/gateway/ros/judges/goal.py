"""Send the tutorial's goal, and end once /odom has it. Arguments: x, y."""

import json
import math
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

goal = float(sys.argv[1]), float(sys.argv[2])
rclpy.init()
node = Node("goal")
here = []
node.create_subscription(
    Odometry, "/odom", lambda m: here.append((m.pose.pose.position.x, m.pose.pose.position.y)), 10
)
goals = node.create_publisher(
    PoseStamped, "/tutorial/goal", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
)
message = PoseStamped()
message.pose.position.x, message.pose.position.y = goal
goals.publish(message)
print(json.dumps({"kind": "begin"}), flush=True)
end = time.monotonic() + 500.0
while not here or math.dist(here[-1], goal) > 0.15:
    if time.monotonic() > end:
        raise SystemExit(f"at {here[-1:]}, not at the goal")
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps({"kind": "there", "off": math.dist(here[-1], goal)}), flush=True)
