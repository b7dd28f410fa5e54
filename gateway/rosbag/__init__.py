"""Other programs' bags (ROS 1 or ROS 2): read as events for perception, and used to evaluate its estimate.

Exports: `read`, `Bag`, `Topic`, `is_bag`; `evaluate.evaluate` gives the error of the estimated path.
Must not import: protocols' drivers, `gateway.core.step`; a bag holds sensor data, not frames of a bus.

Rules. The table [bag] of the robot file maps topics to sensors. A message counts at its header's stamp,
whenever it was written; events are ordered by their stamps, equal stamps by the order of the bag. Of odometry
the twist is used, and converted to wheel angles by the body's kinematics. The ground truth is kept beside the
events, never among them. What is not used is counted by topic and reason: nothing is invented for a field
that its message marks as not measured. A bag that contradicts itself is read, and does not pass
(`gateway.rosbag.contradictions`). One that cannot be read raises `BagError`, whatever the damage.
"""

from gateway.rosbag.bag import Bag, Topic, read
from gateway.rosbag.file import is_bag

__all__ = ["Bag", "Topic", "is_bag", "read"]
