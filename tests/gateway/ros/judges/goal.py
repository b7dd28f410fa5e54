"""Send the tutorial's goal, and end once /odom has it. Arguments: x, y."""

import math
import sys

import rclpy
from client import Client, say
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile

goal = float(sys.argv[1]), float(sys.argv[2])
rclpy.init()
node = Client("goal")
here = []
node.create_subscription(
    Odometry, "/odom", lambda m: here.append((m.pose.pose.position.x, m.pose.pose.position.y)), 10
)
goals = node.create_publisher(
    PoseStamped, "/tutorial/goal", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
)
message = PoseStamped()
message.pose.position.x, message.pose.position.y = goal
node.until(lambda: goals.get_subscription_count() > 0, "somebody who takes the goal")
goals.publish(message)
say("begin")
node.until(lambda: here and math.dist(here[-1], goal) <= 0.15, "the goal")
say("there", off=math.dist(here[-1], goal))
