"""Planning as a ROS 2 node: a grid, /odom and a goal (/tutorial/goal) in, a path by A* out; with the
parameter `leads`, goals of the gateway's own control along that path."""

import heapq
import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

RADIUS = 0.3
"""m that the path keeps from what is occupied."""
AHEAD, NEXT = 0.8, 0.3
"""m along the path to where it leads, and by which that moves before it is told."""


class Planner(Node):
    """Plans anew with each grid."""

    def __init__(self):
        super().__init__("planner")
        self.here = self.goal = None
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.paths = self.create_publisher(Path, "/tutorial/path", 10)
        self.led = None
        leads = self.declare_parameter("leads", False).value
        self.goals = self.create_publisher(PoseStamped, "/goal_pose", 10) if leads else None
        self.create_subscription(Odometry, "/odom", self.on_odometry, 10)
        self.create_subscription(PoseStamped, "/tutorial/goal", self.on_goal, kept)
        self.create_subscription(OccupancyGrid, "/tutorial/map", self.on_grid, kept)

    def on_odometry(self, message):
        self.here = message.pose.pose.position.x, message.pose.pose.position.y

    def on_goal(self, message):
        self.goal = message.pose.position.x, message.pose.position.y

    def on_grid(self, grid):
        if self.here is None or self.goal is None:
            return
        info = grid.info
        cells = np.array(grid.data, np.int8).reshape(info.height, info.width) > 50
        blocked = widened(cells, math.ceil(RADIUS / info.resolution))
        origin = info.origin.position.x, info.origin.position.y
        start, goal = (
            tuple(math.floor((one[i] - origin[i]) / info.resolution) for i in (1, 0))
            for one in (self.here, self.goal)
        )
        path = Path()
        path.header = grid.header
        for row, column in search(blocked, start, goal):
            pose = PoseStamped()
            pose.header = grid.header
            pose.pose.position.x = origin[0] + (column + 0.5) * info.resolution
            pose.pose.position.y = origin[1] + (row + 0.5) * info.resolution
            path.poses.append(pose)
        self.paths.publish(path)
        if self.goals is not None and path.poses:
            self.lead(path.poses)

    def lead(self, poses):
        """Tell where to drive next, in the frame of the map."""
        next_ = poses[min(round(AHEAD / 0.05), len(poses) - 1)]
        at = next_.pose.position.x, next_.pose.position.y
        if self.led is None or math.dist(at, self.led) > NEXT or (next_ is poses[-1] and at != self.led):
            self.led = at
            next_.header.frame_id = "map"
            self.goals.publish(next_)


def widened(cells, radius):
    """Return the cells that lie within a radius of these."""
    found = np.zeros_like(cells)
    rows, columns = np.nonzero(cells)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            if dx * dx + dy * dy <= radius * radius:
                y, x = rows + dy, columns + dx
                inside = (y >= 0) & (y < cells.shape[0]) & (x >= 0) & (x < cells.shape[1])
                found[y[inside], x[inside]] = True
    return found


def search(blocked, start, goal):
    """Return the cells from start to goal (A*, eight neighbours); none if there is no way."""
    inside = (0 <= y < blocked.shape[0] and 0 <= x < blocked.shape[1] for y, x in (start, goal))
    if not all(inside):
        return []
    steps = [(y, x, math.hypot(y, x)) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]
    queue, came, cost = [(0.0, start)], {start: None}, {start: 0.0}
    while queue:
        cell = heapq.heappop(queue)[1]
        if cell == goal:
            break
        for y, x, length in steps:
            there = cell[0] + y, cell[1] + x
            if not (0 <= there[0] < blocked.shape[0] and 0 <= there[1] < blocked.shape[1]):
                continue
            further = cost[cell] + length
            if (blocked[there] and not blocked[start]) or further >= cost.get(there, math.inf):
                continue
            cost[there], came[there] = further, cell
            heapq.heappush(queue, (further + math.dist(there, goal), there))
    found = []
    cell = goal if goal in came else None
    while cell is not None:
        found.append(cell)
        cell = came[cell]
    return found[::-1]


rclpy.init()
rclpy.spin(Planner())
