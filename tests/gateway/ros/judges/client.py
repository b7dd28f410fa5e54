"""What nodes of real ROS 2 (rclpy) that judge the gateway have in common."""

import json
import time

import rclpy
from rclpy.node import Node

PATIENCE = 500.0


def say(kind, **content):
    """Print what was found, as a line of JSON."""
    print(json.dumps({"kind": kind} | content), flush=True)


class Client(Node):
    """A node that waits for what must come."""

    def until(self, condition, what, do=None):
        """Spin until a condition holds; return what it is. `do`: called each time."""
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            if time.monotonic() > end:
                raise SystemExit(f"{what} did not come about")
            if do is not None:
                do()
            rclpy.spin_once(self, timeout_sec=0.02)
        return found

    def call(self, kind, name, request=None):
        """Return the answer of a service."""
        client = self.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request or kind.Request())
        self.until(future.done, f"an answer of {name}")
        return future.result()

    def publisher(self, kind, name):
        """Return a publisher once somebody takes what it publishes."""
        made = self.create_publisher(kind, name, 10)
        self.until(lambda: made.get_subscription_count() > 0, f"a match of {name}")
        return made
