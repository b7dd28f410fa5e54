"""Drive to a goal in simulated time, with a recording: record_a_drive.py [FILE.mcap]."""

import sys

import gateway as gw

path = sys.argv[1] if len(sys.argv) > 1 else "drive.mcap"
with gw.open_session("diffbot", simulated=True, record=path) as session:
    session.submit(gw.Goal(x=1.5, y=0.5))
    for tick in session.run(seconds=8):
        for note in tick.outputs.notes:
            print(f"{tick.seconds:.3f} {note.source}: {note.text}")
    print(f"believed pose: {session.pose}")
print(f"recorded: {path}")
