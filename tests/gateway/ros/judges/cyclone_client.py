"""A client of Cyclone DDS, with types of its own: topics, a service and an action as rmw_cyclonedds has them.

Its requests and replies begin with 16 bytes, of the client and the request's number. Prints what it found as
lines of JSON. Arguments: domain, x, y of the goal.
"""

import json
import os
import sys
import time
from dataclasses import dataclass, field

os.environ["CYCLONEDDS_URI"] = """<CycloneDDS><Domain id="any"><General><Interfaces>
<NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>90</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import (
    array,
    float32,
    float64,
    int8,
    int16,
    int32,
    int64,
    sequence,
    uint8,
    uint16,
    uint32,
)
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PATIENCE = 500.0
RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
KEPT = Qos(RELIABLE, Policy.History.KeepLast(1), Policy.Durability.TransientLocal)
PLAIN = Qos(RELIABLE, Policy.History.KeepLast(10), Policy.Durability.Volatile)


def made(kind):
    return field(default_factory=kind)


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time = made(Time)
    frame_id: str = ""


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point = made(Point)
    orientation: Quaternion = made(Quaternion)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header = made(Header)
    pose: Pose = made(Pose)


@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs.msg.dds_.MapMetaData_"):
    map_load_time: Time = made(Time)
    resolution: float32 = 0.0
    width: uint32 = 0
    height: uint32 = 0
    origin: Pose = made(Pose)


@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs.msg.dds_.OccupancyGrid_"):
    header: Header = made(Header)
    info: MapMetaData = made(MapMetaData)
    data: sequence[int8] = made(list)


@dataclass
class Uuid(IdlStruct, typename="unique_identifier_msgs.msg.dds_.UUID_"):
    uuid: array[uint8, 16] = made(lambda: [0] * 16)


@dataclass
class TriggerRequest(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Request_"):
    client: int64 = 0
    number: int64 = 0
    nothing: uint8 = 0


@dataclass
class TriggerResponse(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Response_"):
    client: int64 = 0
    number: int64 = 0
    success: bool = False
    message: str = ""


@dataclass
class Goal(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_Goal_"):
    pose: PoseStamped = made(PoseStamped)
    behavior_tree: str = ""


@dataclass
class SendGoalRequest(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_SendGoal_Request_"):
    client: int64 = 0
    number: int64 = 0
    goal_id: Uuid = made(Uuid)
    goal: Goal = made(Goal)


@dataclass
class SendGoalResponse(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_SendGoal_Response_"):
    client: int64 = 0
    number: int64 = 0
    accepted: bool = False
    stamp: Time = made(Time)


@dataclass
class GetResultRequest(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_GetResult_Request_"):
    client: int64 = 0
    number: int64 = 0
    goal_id: Uuid = made(Uuid)


@dataclass
class Result(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_Result_"):
    error_code: uint16 = 0
    error_msg: str = ""


@dataclass
class GetResultResponse(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_GetResult_Response_"):
    client: int64 = 0
    number: int64 = 0
    status: int8 = 0
    result: Result = made(Result)


@dataclass
class Feedback(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_Feedback_"):
    current_pose: PoseStamped = made(PoseStamped)
    navigation_time: Time = made(Time)
    estimated_time_remaining: Time = made(Time)
    number_of_recoveries: int16 = 0
    distance_remaining: float32 = 0.0


@dataclass
class FeedbackMessage(IdlStruct, typename="nav2_msgs.action.dds_.NavigateToPose_FeedbackMessage_"):
    goal_id: Uuid = made(Uuid)
    feedback: Feedback = made(Feedback)


participant = DomainParticipant(int(sys.argv[1]))


def say(kind, **content):
    print(json.dumps({"kind": kind} | content), flush=True)


def reader(name, kind, qos=PLAIN):
    return DataReader(participant, Topic(participant, name, kind), qos=qos)


def until(condition, what):
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        if time.monotonic() > end:
            raise SystemExit(f"{what} did not come about")
        time.sleep(0.01)
    return found


class Client:
    """A client of a service."""

    def __init__(self, name, request, response):
        self.writer = DataWriter(participant, Topic(participant, f"rq{name}Request", request), qos=PLAIN)
        self.reader = reader(f"rr{name}Reply", response)
        self.number = 0

    def there(self):
        return self.writer.get_matched_subscriptions() and self.reader.get_matched_publications()

    def call(self, request):
        until(self.there, "a service")
        self.number += 1
        request.client, request.number = 4711, self.number
        self.writer.write(request)
        return lambda: next(
            (r for r in self.reader.take(10) if (r.client, r.number) == (4711, self.number)), None
        )


say("begin")
grids = reader("rt/map", OccupancyGrid, KEPT)
grid = until(lambda: next(iter(grids.take(10)), None), "a map")
say("map", width=grid.info.width, height=grid.info.height, cells=len(grid.data), frame=grid.header.frame_id)

ALL = Qos(RELIABLE, Policy.History.KeepAll, Policy.Durability.Volatile)  # however late it is looked at
feedback = reader("rt/navigate_to_pose/_action/feedback", FeedbackMessage, ALL)
send = Client("/navigate_to_pose/_action/send_goal", SendGoalRequest, SendGoalResponse)
result = Client("/navigate_to_pose/_action/get_result", GetResultRequest, GetResultResponse)
id_ = Uuid(list(range(16)))
x, y = map(float, sys.argv[2:])
goal = Goal(PoseStamped(Header(frame_id="map"), Pose(Point(x, y))))
answer = until(send.call(SendGoalRequest(goal_id=id_, goal=goal)), "an answer to a goal")
say("goal", accepted=answer.accepted)
asked = result.call(GetResultRequest(goal_id=id_))
far = [one.feedback for one in feedback.take(1000)]
found = None


def ended():
    global found
    far.extend(one.feedback for one in feedback.take(1000))
    found = found or asked()
    return found


until(ended, "a result")
say("result", status=found.status, error=found.result.error_code, text=found.result.error_msg)
say("feedback", count=len(far), distances=[round(one.distance_remaining, 3) for one in far])

clear = Client("/diffbot/clear_faults", TriggerRequest, TriggerResponse)
cleared = until(clear.call(TriggerRequest()), "an answer to a request")
say("clear", success=cleared.success, text=cleared.message)
