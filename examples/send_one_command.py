"""Turn one bare motor, and read its encoder."""

import gateway as gw

with gw.open_session("bench", simulated=True) as session:
    left = session.joints["left"]
    for tick in session.run(seconds=2):
        if left.mode is gw.Mode.READY:
            session.submit(gw.Velocity("left", 6.0))  # rad/s at the output shaft, until another command
        for note in tick.outputs.notes:
            print(f"{tick.seconds:.3f} {note.source}: {note.text}")
    print(f"left: {left.mode}, {left.feedback.position:.2f} rad")
