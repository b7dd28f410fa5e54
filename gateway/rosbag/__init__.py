"""Somebody else's bag (ROS 1 or ROS 2) → events for the brain's perception, and a truth to judge it by.

Rules. Such a bag holds what sensors said, not what went over our wires; so it becomes events, and no
driver and no joint has a part in it. The robot file's table [bag] says which topic is what. A message
counts at its header's own stamp, whenever it was written down; events come in the order of their stamps,
those of one stamp in the order of the bag. Of odometry the twist is taken, and made into what each wheel
turned by the body's own kinematics. The truth stands beside the events, never among them. What is not
used is counted by topic and reason: nothing is made up for a field that its message says was not
measured. A bag that cannot be read is a `BagError`, whatever is wrong with it.
"""

from gateway.rosbag.bag import Bag, Topic, read
from gateway.rosbag.file import is_foreign

__all__ = ["Bag", "Topic", "is_foreign", "read"]
