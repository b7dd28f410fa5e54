"""An action client of real ROS 2 (rclpy) and a server of ours: goals succeed, are refused, are cancelled.

Prints what it found as lines of JSON.
"""

import json
import time

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.node import Node
from test_msgs.action import Fibonacci

PATIENCE = 240.0


def say(kind, **content):
    print(json.dumps({"kind": kind} | content), flush=True)


def until(node, condition, what):
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        if time.monotonic() > end:
            raise SystemExit(f"{what} did not come about")
        rclpy.spin_once(node, timeout_sec=0.02)
    return found


def main():
    rclpy.init()
    node = Node("client")
    client = ActionClient(node, Fibonacci, "/fibonacci")
    until(node, client.server_is_ready, "a server")
    feedback = []

    def send(order):
        future = client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda m: feedback.append(list(m.feedback.sequence)),
        )
        until(node, future.done, "an answer to a goal")
        return future.result()

    goal = send(4)
    result = goal.get_result_async()
    until(node, result.done, "a result")
    say(
        "done",
        accepted=goal.accepted,
        status=result.result().status,
        sequence=list(result.result().result.sequence),
        feedback=feedback[:],
    )
    say("refused", accepted=send(-1).accepted)
    goal = send(1000)
    until(node, lambda: goal.status == GoalStatus.STATUS_EXECUTING, "a goal under way")
    result = goal.get_result_async()
    cancelled = goal.cancel_goal_async()
    until(node, cancelled.done, "an answer to a cancel")
    until(node, result.done, "a result")
    say(
        "cancelled",
        code=cancelled.result().return_code,
        goals=len(cancelled.result().goals_canceling),
        status=result.result().status,
    )
    again = goal.cancel_goal_async()
    until(node, again.done, "an answer to a cancel")
    say("again", code=again.result().return_code)
    rclpy.shutdown()


main()
