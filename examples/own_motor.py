"""A protocol plugin for a motor of your own: written from the template, checked, driven by a robot file."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import gateway as gw
from gateway.cli import scaffold
from protocols.conformance import check, table
from protocols.plugin import load

ROBOT = """
name = "mine"
[buses.can0]
kind = "can"
interface = "twin"
bitrate = 1000000
[motors.left]
protocol = "my_motor"
bus = "can0"
address = 1
limits = { velocity = 5.0, acceleration = 10.0, torque = 1.0 }
[brain]
body = "joints"
[brain.joints]
motors = ["left"]
"""

with TemporaryDirectory() as folder:
    made = scaffold.new("my_motor", "can", Path(folder))  # as `gateway protocols new my_motor --bus can` does
    print("written:", ", ".join(sorted(path.name for path in made.files)))
    sys.path.insert(0, str(made.folder))
    from my_motor import plugin  # type: ignore[import-not-found]  # `pip install -e my_motor` registers it

    results = check(plugin)
    print(table(results))
    robot = gw.parse_robot(ROBOT, find=lambda name: plugin if name == plugin.name else load(name))
    with gw.open_session(robot, simulated=True) as session:
        for tick in session.run(seconds=2):
            if tick.seconds > 0.5:
                session.submit(gw.Velocity("left", 2.0))
        print(f"left turned by {session.joints['left'].feedback.position:.2f} rad")
    failed = [result.clause for result in results if result.outcome == "failed"]
    print("to do: real bytes in vectors.json" if failed == ["vectors"] else f"failed: {failed}")
    sys.exit(failed != ["vectors"])
