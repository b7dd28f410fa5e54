"""Other programs' recordings (bags of ROS 1 and 2, CARMEN logs): read as events for perception, and used to
evaluate its estimate.

Exports: `read`, `Bag`, `Topic`, `is_bag`; `evaluate.evaluate` gives the error of the estimated path.
Must not import: protocols' drivers, `gateway.core.step`; a bag holds sensor data, not frames of a bus.

Rules. The table [bag] of the robot file maps topics to sensors. A message counts at its header's stamp,
whenever it was written; events are ordered by their stamps, equal stamps by the order of the bag. How the
base moved (twists, poses, angles of joints) is converted to joint angles by the body's kinematics. The ground
truth is kept beside the events, never among them. What is not used is counted by topic and reason: nothing is
invented for a field that its message marks as not measured. A bag that contradicts itself is read, and does
not pass (`gateway.rosbag.contradictions`). One that cannot be read raises `BagError`, whatever the damage.
"""

from gateway.rosbag.bag import Bag, read
from gateway.rosbag.source import is_bag
from gateway.rosbag.topic import Topic

__all__ = ["Bag", "Topic", "is_bag", "read"]
