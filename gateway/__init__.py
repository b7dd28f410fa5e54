"""Motor Gateway: one brain, any body, over real wires.

To run a robot::

    import gateway as gw

    robot = gw.load_robot("diffbot")                      # a name, or the path of a robot file
    with gw.open_session(robot, simulated=True, record="drive.mcap") as session:
        session.submit(gw.Goal(x=1.5, y=0.5))
        for tick in session.run(seconds=8):
            for note in tick.outputs.notes:
                print(f"{tick.seconds:.3f} {note.source}: {note.text}")
        print(session.pose, session.joints["left"].feedback.position)

a mission, from a file or as data::

    session.submit(gw.load_mission("rounds"))
    session.submit(gw.Mission("fetch", (gw.Goal(2.0, 1.0), gw.Turn(0.5), gw.Move(0.2, distance=1.0))))

and for a program that has a loop of its own::

    core = gw.Gateway(robot)
    outputs = core.step(now, gw.Inputs(packets=received))  # now: int nanoseconds; send outputs.packets
    core.due()                                             # when a driver next has to send by itself

All quantities are SI (rad, rad/s, N·m, m, s, A, V, degrees Celsius) at the joint's output shaft. Everything
in `__all__` is public; names are imported when they are first used, so that `import gateway` is quick.
Every error derives from `GatewayError` (gateway.errors has the tree). Protocol plugins import `protocols`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brain.belief import Belief as Belief
    from brain.belief import Pose as Pose
    from gateway.config import describe as describe
    from gateway.config import load_mission as load_mission
    from gateway.config import load_robot as load_robot
    from gateway.config import parse_mission as parse_mission
    from gateway.config import parse_robot as parse_robot
    from gateway.config import with_interfaces as with_interfaces
    from gateway.core.joint import Joint as Joint
    from gateway.core.robot import Robot as Robot
    from gateway.core.step import Gateway as Gateway
    from gateway.core.tick import Inputs as Inputs
    from gateway.core.tick import Note as Note
    from gateway.core.tick import Outputs as Outputs
    from gateway.core.tick import Tick as Tick
    from gateway.errors import BagError as BagError
    from gateway.errors import BusError as BusError
    from gateway.errors import ConfigError as ConfigError
    from gateway.errors import GatewayError as GatewayError
    from gateway.errors import OperatorError as OperatorError
    from gateway.errors import ProtocolNotFound as ProtocolNotFound
    from gateway.errors import RecordingError as RecordingError
    from gateway.errors import UserError as UserError
    from gateway.operator import ask as ask
    from gateway.recording import Recording as Recording
    from gateway.recording import read_recording as read_recording
    from gateway.replay import Comparison as Comparison
    from gateway.replay import SignalLog as SignalLog
    from gateway.replay import log_of as log_of
    from gateway.replay import replay_recording as replay_recording
    from gateway.report import draw_map as draw_map
    from gateway.report import write_report as write_report
    from gateway.runtime.session import Session as Session
    from gateway.runtime.session import open_session as open_session
    from protocols.frames import BusState as BusState
    from protocols.frames import CanFrame as CanFrame
    from protocols.frames import Packet as Packet
    from protocols.messages import ClearFault as ClearFault
    from protocols.messages import Dock as Dock
    from protocols.messages import Drive as Drive
    from protocols.messages import Drop as Drop
    from protocols.messages import Fault as Fault
    from protocols.messages import Feedback as Feedback
    from protocols.messages import Follow as Follow
    from protocols.messages import Goal as Goal
    from protocols.messages import Hold as Hold
    from protocols.messages import Idle as Idle
    from protocols.messages import Impedance as Impedance
    from protocols.messages import Locate as Locate
    from protocols.messages import Mission as Mission
    from protocols.messages import Mode as Mode
    from protocols.messages import Move as Move
    from protocols.messages import MoveTool as MoveTool
    from protocols.messages import Pause as Pause
    from protocols.messages import Perform as Perform
    from protocols.messages import Position as Position
    from protocols.messages import Reach as Reach
    from protocols.messages import Release as Release
    from protocols.messages import Repeat as Repeat
    from protocols.messages import Resume as Resume
    from protocols.messages import Stop as Stop
    from protocols.messages import Torque as Torque
    from protocols.messages import Try as Try
    from protocols.messages import Turn as Turn
    from protocols.messages import Velocity as Velocity
    from protocols.messages import Wait as Wait

    __version__: str

_MODULES = {
    "brain.belief": ("Belief", "Pose"),
    "gateway.config": (
        "describe",
        "load_mission",
        "load_robot",
        "parse_mission",
        "parse_robot",
        "with_interfaces",
    ),
    "gateway.core.joint": ("Joint",),
    "gateway.core.robot": ("Robot",),
    "gateway.core.step": ("Gateway",),
    "gateway.core.tick": ("Inputs", "Note", "Outputs", "Tick"),
    "gateway.errors": (
        "BagError",
        "BusError",
        "ConfigError",
        "GatewayError",
        "OperatorError",
        "ProtocolNotFound",
        "RecordingError",
        "UserError",
    ),
    "gateway.operator": ("ask",),
    "gateway.recording": ("Recording", "read_recording"),
    "gateway.replay": ("Comparison", "SignalLog", "log_of", "replay_recording"),
    "gateway.report": ("draw_map", "write_report"),
    "gateway.runtime.session": ("Session", "open_session"),
    "protocols.frames": ("BusState", "CanFrame", "Packet"),
    "protocols.messages": (
        "ClearFault",
        "Dock",
        "Drive",
        "Drop",
        "Fault",
        "Feedback",
        "Follow",
        "Goal",
        "Hold",
        "Idle",
        "Impedance",
        "Locate",
        "Mission",
        "Mode",
        "Move",
        "MoveTool",
        "Pause",
        "Perform",
        "Position",
        "Reach",
        "Release",
        "Repeat",
        "Resume",
        "Stop",
        "Torque",
        "Try",
        "Turn",
        "Velocity",
        "Wait",
    ),
}
_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = [*sorted(_OF), "__version__"]  # noqa: PLE0604 -- names, made from the table above


def _check_packages() -> None:
    """Raise ImportError if a file of the user's, beside a script say, hides one of our packages."""
    root = Path(__file__).resolve().parents[1]
    for name in ("brain", "protocols"):
        found = find_spec(name)
        places = (found and found.submodule_search_locations) or ()
        if root / name not in (Path(each).resolve() for each in places):
            what = (found and found.origin) or ", ".join(places) or "nothing"
            raise ImportError(
                f"motor-gateway needs its own package {name!r}, and {what} is found in its place: "
                "rename that, or start Python where it is not found first"
            )


_check_packages()


def __getattr__(name: str) -> object:
    """Import a public name when it is first used (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        value: object = version("motor-gateway")
    elif name in _OF:
        value = getattr(import_module(_OF[name]), name)
    else:
        raise AttributeError(f"module 'gateway' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
