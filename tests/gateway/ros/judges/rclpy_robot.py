"""A node of real ROS 2 (rclpy): it subscribes to everything, drives a square, sends a goal, stops the robot.

Prints what it found as lines of JSON. Arguments: x, y of the goal; how many topics the robot publishes and
takes, and how many services it has.
"""

import math
import sys
import time
from functools import partial

import rclpy
from client import Client, say
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rcl_interfaces.msg import Log, ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan
from std_srvs.srv import Trigger

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {
    "/odom": (Odometry, 50),
    "/estimate": (PoseWithCovarianceStamped, 50),
    "/joint_states": (JointState, 50),
    "/scan": (LaserScan, qos_profile_sensor_data),
    "/imu/data": (Imu, 50),
    "/map": (OccupancyGrid, KEPT),
    "/plan": (Path, 10),
    "/diagnostics": (DiagnosticArray, 10),
    "/battery_state": (BatteryState, 10),
    "/rosout": (Log, 100),
    "/clock": (Clock, 10),
}
SIDE, SPEED, TURN = 0.15, 0.25, 1.5


def seconds(stamp):
    return stamp.sec + stamp.nanosec / 1e9


def yaw(q):
    return 2.0 * math.atan2(q.z, q.w)


class Judge(Client):
    def __init__(self):
        super().__init__("judge")
        self.got = {name: [] for name in TOPICS}
        for name, (kind, qos) in TOPICS.items():
            self.create_subscription(kind, name, self.got[name].append, qos)
        self.twists = self.create_publisher(Twist, "/cmd_vel", 10)
        self.goals = self.create_publisher(PoseStamped, "/goal_pose", 10)

    @property
    def pose(self):
        pose = self.got["/odom"][-1].pose.pose
        return pose.position.x, pose.position.y, yaw(pose.orientation)

    def drive(self, linear, angular):
        twist = Twist()
        twist.linear.x, twist.angular.z = linear, angular
        self.twists.publish(twist)

    def square(self):
        x, y, heading = self.pose
        for side in range(4):
            self.side(self.pose[:2], heading + side * math.pi / 2)
            self.turn(heading + (side + 1) * math.pi / 2)
        return math.dist(self.pose[:2], (x, y))

    def side(self, begin, heading):
        def left():
            dx, dy = self.pose[0] - begin[0], self.pose[1] - begin[1]
            return SIDE - dx * math.cos(heading) - dy * math.sin(heading)

        self.servo(left, 0.01, lambda far: self.drive(max(-SPEED, min(SPEED, 2 * far)), 0.0), "a side")

    def turn(self, heading):
        def left():
            return (heading - self.pose[2] + math.pi) % (2 * math.pi) - math.pi

        self.servo(left, 0.05, lambda far: self.drive(0.0, max(-TURN, min(TURN, 3 * far))), "a turn")

    def servo(self, left, near, drive, what):
        """Drive until it stands where nothing is left, also back: this process may be late."""

        def there():
            twist = self.got["/odom"][-1].twist.twist
            return abs(left()) < near and abs(twist.linear.x) < 0.01 and abs(twist.angular.z) < 0.02

        self.until(there, what, lambda: drive(left() if abs(left()) > near / 2 else 0.0))
        self.drive(0.0, 0.0)


def main():
    goal = float(sys.argv[1]), float(sys.argv[2])
    rclpy.init()
    judge = Judge()
    say("begin")
    first = [name for name in TOPICS if name not in ("/plan",)]
    judge.until(lambda: all(judge.got[name] for name in first), "a message of every topic")
    known = lambda: ("diffbot", "/") in judge.get_node_names_and_namespaces()  # noqa: E731
    judge.until(known, "the node of the robot")
    of_node = partial(judge.get_publisher_names_and_types_by_node, "diffbot", "/")
    judge.until(lambda: len(of_node()) >= int(sys.argv[3]), "all that the robot publishes")
    to_node = partial(judge.get_subscriber_names_and_types_by_node, "diffbot", "/")
    judge.until(lambda: len(to_node()) >= int(sys.argv[4]), "all that it takes")
    services = partial(judge.get_service_names_and_types_by_node, "diffbot", "/")
    judge.until(lambda: len(services()) >= int(sys.argv[5]), "all its services")
    say("nodes", names=[list(one) for one in judge.get_node_names_and_namespaces()])
    infos = {name: judge.get_publishers_info_by_topic(name)[0] for name in TOPICS if name not in ("/rosout",)}
    say("infos", of={n: [i.node_name, i.topic_type, str(i.topic_type_hash)] for n, i in infos.items()})
    say("graph", published=dict(of_node()), taken=dict(to_node()))
    say("actions", names=[n for n, _ in get_action_server_names_and_types_by_node(judge, "diffbot", "/")])
    qos = {n: judge.get_publishers_info_by_topic(n)[0].qos_profile for n in ("/map", "/odom")}
    say("qos", of={n: [one.reliability.name, one.durability.name] for n, one in qos.items()})
    say("services", names=[name for name, _ in services()])
    scan, grid, joints = (judge.got[n][-1] for n in ("/scan", "/map", "/joint_states"))
    say(
        "scan", frame=scan.header.frame_id, ranges=list(map(float, scan.ranges)), t=seconds(scan.header.stamp)
    )
    say(
        "map",
        width=grid.info.width,
        height=grid.info.height,
        cells=len(grid.data),
        frame=grid.header.frame_id,
    )
    say("joints", names=sorted(joints.name))
    say("battery", volts=judge.got["/battery_state"][-1].voltage)

    listed = judge.call(ListParameters, "/diffbot/list_parameters", ListParameters.Request()).result.names
    name = "left.limits.velocity"
    value = judge.call(
        GetParameters, "/diffbot/get_parameters", GetParameters.Request(names=[name, "none"])
    ).values
    described = judge.call(
        DescribeParameters, "/diffbot/describe_parameters", DescribeParameters.Request(names=[name])
    )
    ranges = described.descriptors[0].floating_point_range
    half = Parameter(name, Parameter.Type.DOUBLE, value[0].double_value / 2).to_parameter_msg()
    request = SetParameters.Request(
        parameters=[half, Parameter("none", Parameter.Type.DOUBLE, 1.0).to_parameter_msg()]
    )
    done = judge.call(SetParameters, "/diffbot/set_parameters", request).results
    get = GetParameters.Request(names=[name])

    def halved():
        values = judge.call(GetParameters, "/diffbot/get_parameters", get).values
        return [one.double_value for one in values if one.double_value == value[0].double_value / 2]

    say(
        "parameters",
        listed=list(listed),
        value=value[0].double_value,
        unknown=value[1].type == ParameterType.PARAMETER_NOT_SET,
        high=ranges[0].to_value,
        set=[one.successful for one in done],
        now=judge.until(halved, "a parameter that is set")[0],
    )
    back = Parameter(name, Parameter.Type.DOUBLE, value[0].double_value).to_parameter_msg()
    judge.call(SetParameters, "/diffbot/set_parameters", SetParameters.Request(parameters=[back]))

    say("square", off=judge.square())
    stamped = PoseStamped()
    stamped.header.frame_id = "map"
    stamped.pose.position.x, stamped.pose.position.y = goal
    stamped.pose.orientation.w = 1.0
    judge.goals.publish(stamped)

    def off():
        pose = judge.got["/estimate"][-1].pose.pose.position
        return math.dist((pose.x, pose.y), goal)

    judge.until(lambda: off() < 0.15, "the goal")
    say(
        "goal", off=off(), plans=len(judge.got["/plan"]), points=max(len(p.poses) for p in judge.got["/plan"])
    )

    told = PoseWithCovarianceStamped()
    told.header.frame_id, told.pose = "map", judge.got["/estimate"][-1].pose
    told.pose.covariance[0] = told.pose.covariance[7] = 0.01
    told.pose.covariance[35] = 0.01
    places = judge.create_publisher(PoseWithCovarianceStamped, "/initialpose", 10)
    judge.until(lambda: places.get_subscription_count() > 0, "a match of /initialpose")
    places.publish(told)

    def heard():
        return [m.msg for m in judge.got["/rosout"] if m.msg.startswith("told that it is at")]

    say("told", text=judge.until(heard, "a note about the place")[0])
    poses = {seconds(m.header.stamp): m.pose.pose for m in judge.got["/odom"]}
    say("odom", poses=[[t, p.position.x, p.position.y, yaw(p.orientation)] for t, p in poses.items()])
    maps = {seconds(m.header.stamp): m.pose.pose for m in judge.got["/estimate"]}
    say("estimate", poses=[[t, p.position.x, p.position.y, yaw(p.orientation)] for t, p in maps.items()])

    answer = judge.call(Trigger, "/diffbot/stop", Trigger.Request())
    say("stop", success=answer.success, message=answer.message)
    judge.until(lambda: abs(judge.got["/odom"][-1].twist.twist.linear.x) < 1e-3, "rest")
    end = time.monotonic() + 1.0
    x, y, _ = judge.pose
    judge.until(lambda: time.monotonic() > end, "", lambda: judge.drive(SPEED, 0.0))
    said = [m.msg for m in judge.got["/rosout"]]
    say(
        "stopped",
        moved=math.dist(judge.pose[:2], (x, y)),
        refused=[m for m in said if m.startswith("/cmd_vel: stopped")],
    )
    rclpy.shutdown()


main()
