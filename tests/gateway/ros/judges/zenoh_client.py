"""A peer of zenoh in a process of its own, with the messages of real ROS 2: it finds a robot by liveliness
tokens, takes topics, drives it, calls services and sends a goal, as rmw_zenoh does.

Prints what it found as lines of JSON. Arguments: domain, endpoint, and "robot" or "action". Nothing of the
gateway is imported: keys and attachments are made here, by ros2/rmw_zenoh, docs/design.md.
"""

import json
import struct
import sys
import time

import xxhash
import zenoh
import zenoh.ext
from geometry_msgs.msg import Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from zenoh.handlers import RingChannel

PATIENCE = 500.0
DOMAIN, ENDPOINT, PART = sys.argv[1:4]
SPEED = 0.1


def say(kind, **content):
    print(json.dumps({"kind": kind} | content), flush=True)


def until(condition, what, do=None):
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        if time.monotonic() > end:
            raise SystemExit(f"{what} did not come about")
        if do is not None:
            do()
        time.sleep(0.02)
    return found


class Client:
    def __init__(self):
        config = {
            "mode": "client",
            "connect": {"endpoints": [ENDPOINT], "timeout_ms": -1},
            "scouting": {"multicast": {"enabled": False}},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.tokens, self.numbers, self.held = {}, {}, []
        everything = f"@ros2_lv/{DOMAIN}/**"
        self.graph = self.session.liveliness().declare_subscriber(
            everything, RingChannel(20000), history=True
        )

    def look(self):
        while (one := self.graph.try_recv()) is not None:
            parts = str(one.key_expr).split("/")
            if one.kind == zenoh.SampleKind.PUT:
                self.tokens[str(one.key_expr)] = parts
            else:
                self.tokens.pop(str(one.key_expr), None)
        return self.tokens.values()

    def endpoint(self, kind, name, type_=""):
        """Return the token of an endpoint of the robot's, in parts, once there is one; of two types, this."""
        flat = name.replace("/", "%")

        def fits():
            known = [one for one in self.look() if len(one) == 13]
            return [one for one in known if (one[5], one[9]) == (kind, flat) and one[10].endswith(type_)]

        return until(fits, f"a token of {kind} {name}")[0]

    def key(self, kind, name, type_=""):
        """Return the key of data: with the type and hash that the robot's token names."""
        parts = self.endpoint(kind, name, type_)
        return f"{DOMAIN}/{name.strip('/')}/{parts[10]}/{parts[11]}"

    def token(self, kind, name, of, type_=""):
        """Tell of an endpoint of ours; return its 16 bytes."""
        parts = self.endpoint(of, name, type_)
        mine = [f"@ros2_lv/{DOMAIN}", str(self.session.zid()), "0", str(len(self.held) + 1), kind, "%", "%"]
        text = "/".join([*mine, "judge", *parts[9:12], "::,10:,:,:,,"])
        self.held.append(self.session.liveliness().declare_token(text))
        both = xxhash.xxh3_128_intdigest(text.encode())
        return struct.pack("<QQ", both & (1 << 64) - 1, both >> 64)

    def subscribe(self, name, kept=False):
        key, _ = self.key("MP", name), self.token("MS", name, "MP")
        if kept:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            made = zenoh.ext.declare_advanced_subscriber(self.session, key, RingChannel(64), history=history)
        else:
            made = self.session.declare_subscriber(key, RingChannel(64))
        self.held.append(made)
        return made

    def attachment(self, whose):
        self.numbers[whose] = self.numbers.get(whose, 0) + 1
        return struct.pack("<qqB16s", self.numbers[whose], time.time_ns(), 16, whose)

    def call(self, name, type_, request):
        """Call a service; return its response."""
        whose, key = self.token("SC", name, "SS"), self.key("SS", name)
        sent = self.attachment(whose)
        replies = self.session.get(
            key,
            payload=serialize_message(request),
            attachment=sent,
            timeout=PATIENCE,
            target=zenoh.QueryTarget.ALL,
        )
        reply = next(iter(replies)).ok
        number, _, _, back = struct.unpack("<qqB16s", bytes(reply.attachment))
        assert (number, back) == (self.numbers[whose], whose), "the reply is to another request"
        return deserialize_message(bytes(reply.payload), type_.Response)


def latest(subscriber, type_):
    found = None
    while (one := subscriber.try_recv()) is not None:
        found = one
    return (
        None if found is None else (deserialize_message(bytes(found.payload), type_), bytes(found.attachment))
    )


def robot(client):
    say(
        "node",
        tokens=sorted("/".join(p[5:]) for p in until(lambda: [*client.look()], "tokens") if p[5] == "NN"),
    )
    parts = client.endpoint("MP", "/map")
    say("map_token", type=parts[10], hash=parts[11], qos=parts[12])
    odom = client.subscribe("/odom")
    message, attached = until(lambda: latest(odom, Odometry), "an odometry")
    say("odom", frame=message.header.frame_id, child=message.child_frame_id, attachment=attached.hex())
    grids = client.subscribe("/map", kept=True)
    grid, _ = until(lambda: latest(grids, OccupancyGrid), "a map")
    say("map", cells=len(grid.data), size=grid.info.width * grid.info.height)
    whose, key = (client.token("MP", "/cmd_vel", "MS", "::Twist_"), client.key("MS", "/cmd_vel", "::Twist_"))
    twist = Twist()
    twist.linear.x = SPEED

    def drive():
        client.session.put(key, serialize_message(twist), attachment=client.attachment(whose))

    def driving():
        found = latest(odom, Odometry)
        return found if found is not None and found[0].twist.twist.linear.x > 0.8 * SPEED else None

    say("driven", speed=until(driving, "a speed", drive)[0].twist.twist.linear.x)
    answer = client.call("/diffbot/stop", Trigger, Trigger.Request())
    say("stop", success=answer.success, message=answer.message)


def action(client):
    name, services = "/fibonacci/_action", Fibonacci.Impl
    feedback = client.subscribe(f"{name}/feedback")
    request = services.SendGoalService.Request()
    request.goal_id.uuid = list(range(16))
    request.goal.order = 4
    say("sent", accepted=client.call(f"{name}/send_goal", services.SendGoalService, request).accepted)
    result = services.GetResultService.Request(goal_id=request.goal_id)
    found = client.call(f"{name}/get_result", services.GetResultService, result)
    say("result", status=found.status, sequence=list(found.result.sequence))
    message, _ = until(lambda: latest(feedback, services.FeedbackMessage), "feedback")
    say("feedback", sequence=list(message.feedback.sequence))


def main():
    say("begin")
    client = Client()
    (robot if PART == "robot" else action)(client)
    client.session.close()


main()
