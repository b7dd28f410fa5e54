"""A node of real ROS 2 (rclpy): it finds a robot by the names of its file, and moves its joints.

Prints what it found as lines of JSON."""

import rclpy
from client import Client, say
from rcl_interfaces.srv import ListParameters
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

WANTED, TURN = [2.0, -1.0], 0.5


class Judge(Client):
    def __init__(self):
        super().__init__("judge")
        self.states = []
        self.create_subscription(JointState, "/arm/states", self.states.append, 10)

    def now(self, what):
        """Return what the joints have: in the order of the robot file, whatever that of the message is."""
        values = dict(zip(self.states[-1].name, getattr(self.states[-1], what), strict=True))
        return [values["left"], values["right"]]

    def near(self, what, wanted, within):
        return all(abs(a - b) < within for a, b in zip(self.now(what), wanted, strict=True))


def main():
    rclpy.init()
    judge = Judge()
    judge.until(lambda: judge.states and len(judge.states[-1].name) == 2, "a state of both joints")
    known = lambda: ("rover", "/left") in judge.get_node_names_and_namespaces()  # noqa: E731
    judge.until(known, "the node of the robot")
    of = lambda name: [one.node_name for one in judge.get_publishers_info_by_topic(name)]  # noqa: E731
    judge.until(lambda: of("/arm/states") == ["rover"], "the publisher of the states")
    say("topics", of={name: of(name) for name in ("/arm/states", "/left/joint_states")})
    say("parameters", listed=list(judge.call(ListParameters, "/left/rover/list_parameters").result.names))
    say("states", names=sorted(judge.states[-1].name))

    arrays = judge.publisher(Float64MultiArray, "/left/velocity_controller/commands")
    fast = lambda: judge.near("velocity", WANTED, 0.1)  # noqa: E731
    judge.until(fast, "velocities", lambda: arrays.publish(Float64MultiArray(data=WANTED)))
    say("velocity", values=judge.now("velocity"))
    judge.until(lambda: judge.near("velocity", [0.0, 0.0], 0.01), "rest, by silence")

    goal = [position + TURN for position in judge.now("position")]
    motion = JointTrajectory(joint_names=["left", "right"], points=[JointTrajectoryPoint(positions=goal)])
    motion.points[0].time_from_start.sec = 1
    judge.publisher(JointTrajectory, "/left/joint_trajectory_controller/joint_trajectory").publish(motion)
    judge.until(lambda: judge.near("position", goal, 0.02), "the end of a trajectory")
    say("trajectory", goal=goal, values=judge.now("position"))

    for kind, name in (("stop", "/left/rover/stop"), ("zero", "/left/rover/left/zero"), ("go_on", "/go_on")):
        answer = judge.call(Trigger, name)
        while kind == "zero" and not answer.success:  # while it brakes, it is armed
            answer = judge.call(Trigger, name)
        say(kind, success=answer.success, message=answer.message)
    rclpy.shutdown()


main()
