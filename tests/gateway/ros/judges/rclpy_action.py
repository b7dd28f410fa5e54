"""An action client of real ROS 2 (rclpy) and a server of ours: goals succeed, are refused, are cancelled.

Prints what it found as lines of JSON.
"""

import rclpy
from action_msgs.msg import GoalStatus
from client import Client, say
from rclpy.action import ActionClient
from test_msgs.action import Fibonacci


def main():
    rclpy.init()
    node = Client("client")
    client = ActionClient(node, Fibonacci, "/fibonacci")
    node.until(client.server_is_ready, "a server")
    feedback = []

    def send(order):
        future = client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda m: feedback.append(list(m.feedback.sequence)),
        )
        node.until(future.done, "an answer to a goal")
        return future.result()

    goal = send(4)
    result = goal.get_result_async()
    node.until(result.done, "a result")
    say(
        "done",
        accepted=goal.accepted,
        status=result.result().status,
        sequence=list(result.result().result.sequence),
        feedback=feedback[:],
    )
    say("refused", accepted=send(-1).accepted)
    goal = send(1000)
    node.until(lambda: goal.status == GoalStatus.STATUS_EXECUTING, "a goal under way")
    result = goal.get_result_async()
    cancelled = goal.cancel_goal_async()
    node.until(cancelled.done, "an answer to a cancel")
    node.until(result.done, "a result")
    say(
        "cancelled",
        code=cancelled.result().return_code,
        goals=len(cancelled.result().goals_canceling),
        status=result.result().status,
    )
    again = goal.cancel_goal_async()
    node.until(again.done, "an answer to a cancel")
    say("again", code=again.result().return_code)
    rclpy.shutdown()


main()
