"""Turn one bare motor for a second, and read its encoder."""

import gateway as gw

with gw.open_session("bench", simulated=True) as session:
    for tick in session.run(seconds=2):
        if 0.5 <= tick.seconds < 1.5:  # a command holds for the joint's command timeout: repeat it
            session.submit(gw.Velocity("left", 6.0))  # rad/s at the output shaft
        for note in tick.outputs.notes:
            print(f"{tick.seconds:.3f} {note.source}: {note.text}")
    left = session.joints["left"]
    print(f"left: {left.mode}, {left.feedback.position:.2f} rad after one second at 6 rad/s")
