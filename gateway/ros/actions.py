"""The server's side of ROS 2's actions: goals with their states, results that are waited for, cancelling.

Rules. An action has one goal under way: a new one takes its place, and the old one is aborted. What a goal
does to the robot, and how it ends, is the bridge's; here is the protocol. Everything is bounded.

Source: design.ros2.org/articles/actions.html; action_msgs/GoalStatus (states), CancelGoal (return codes).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gateway.ros.types import encode, make

ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 3, 4, 5, 6
UNKNOWN = 0
ENDED = (SUCCEEDED, CANCELED, ABORTED)
NO_GOAL, TERMINATED = 2, 3
"""Codes of CancelGoal"""
MOST_KEPT, MOST_WAITING = 20, 20
Token = Sequence[Any]
ACTION_STAMP = "builtin_interfaces/msg/Time"


@dataclass(slots=True)
class Goal:
    """One goal of a client."""

    id: bytes
    content: Any
    """What it asks"""
    stamp: Any
    status: int = ACCEPTED
    result: bytes = b""
    """The response to who asks for its result; b"" before it has ended"""
    waiting: list[Token] = field(default_factory=list)
    """Who asks for it"""


@dataclass(slots=True)
class Action:
    """One action.

    Args:
        name: in the table of the graph.
        type: package/action/Name.
        publish: sends a message on a topic of the table.
        answer: answers a request.
    """

    name: str
    type: str
    publish: Callable[[str, bytes], None]
    answer: Callable[[str, bytes, Token], None]
    goals: dict[bytes, Goal] = field(default_factory=dict)
    """By id, the oldest first"""

    @property
    def active(self) -> Goal | None:
        """The goal under way."""
        return next((goal for goal in self.goals.values() if goal.status not in ENDED), None)

    def send_goal(
        self,
        id_: bytes,
        content: Any,  # noqa: ANN401 -- what a goal of this action is
        stamp: Any,  # noqa: ANN401 -- a message
        token: Token,
        refused: Callable[[Any], str],
    ) -> Goal | None:
        """Answer who sends a goal; return it if it is accepted. `refused`: why its content is not, or ""."""
        accepted = id_ not in self.goals and not refused(content)
        made = Goal(id_, content, stamp) if accepted else None
        response = make(f"{self.type}_SendGoal_Response", accepted=accepted, stamp=stamp)
        self.answer(f"{self.name}/_action/send_goal", encode(response), token)
        if made is None:
            return None
        self.goals[id_] = made
        for old in [one for one in self.goals.values() if one.status in ENDED][: -MOST_KEPT or None]:
            del self.goals[old.id]
        self.tell()
        return made

    def get_result(self, request: Any, token: Token) -> None:  # noqa: ANN401 -- a message
        """Answer who asks for a result, now or when there is one."""
        goal = self.goals.get(bytes(request.goal_id.uuid))
        if goal is None:
            self._give(encode(make(f"{self.type}_GetResult_Response", status=UNKNOWN)), token)
        elif goal.result:
            self._give(goal.result, token)
        elif len(goal.waiting) < MOST_WAITING:
            goal.waiting.append(token)

    def cancel(self, request: Any, token: Token) -> list[Goal]:  # noqa: ANN401 -- a message
        """Answer who cancels; return the goals that are to end. An id of zeros: all of that age or older."""
        info = request.goal_info
        id_, until = bytes(info.goal_id.uuid), (info.stamp.sec, info.stamp.nanosec)
        if any(id_):
            known = self.goals.get(id_)
            found = [known] if known is not None and known.status not in ENDED else []
            code = 0 if found else NO_GOAL if known is None else TERMINATED
        else:
            found = [one for one in self.goals.values() if one.status not in ENDED]
            if any(until):
                found = [one for one in found if (one.stamp.sec, one.stamp.nanosec) <= until]
            code = 0
        infos = [_info(one) for one in found]
        response = make("action_msgs/srv/CancelGoal_Response", return_code=code, goals_canceling=infos)
        self.answer(f"{self.name}/_action/cancel_goal", encode(response), token)
        for one in found:
            self.set(one, CANCELING)
        return found

    def set(self, goal: Goal, status: int, result: Any = None) -> None:  # noqa: ANN401 -- a message
        """Change the state of a goal; one that ends has a result."""
        if goal.status in ENDED:
            return
        goal.status = status
        if status in ENDED:
            made = make(f"{self.type}_GetResult_Response", status=status, result=result)
            goal.result = encode(made)
            for token in goal.waiting:
                self._give(goal.result, token)
            goal.waiting.clear()
        self.tell()

    def feedback(self, goal: Goal, content: Any) -> None:  # noqa: ANN401 -- a message
        """Send how far a goal is."""
        made = make(f"{self.type}_FeedbackMessage", goal_id=_uuid(goal), feedback=content)
        self.publish(f"{self.name}/_action/feedback", encode(made))

    def tell(self) -> None:
        """Send the states of all goals."""
        statuses = [
            make("action_msgs/msg/GoalStatus", goal_info=_info(one), status=one.status)
            for one in self.goals.values()
        ]
        self.publish(
            f"{self.name}/_action/status",
            encode(make("action_msgs/msg/GoalStatusArray", status_list=statuses)),
        )

    def _give(self, result: bytes, token: Token) -> None:
        self.answer(f"{self.name}/_action/get_result", result, token)


def _uuid(goal: Goal) -> Any:  # noqa: ANN401
    return make("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(goal.id, np.uint8))


def _info(goal: Goal) -> Any:  # noqa: ANN401
    return make("action_msgs/msg/GoalInfo", goal_id=_uuid(goal), stamp=goal.stamp)
