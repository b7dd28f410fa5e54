"""Turn one bare motor, and read its encoder."""

import gateway as gw

with gw.open_session("bench", simulated=True) as session:
    session.submit(gw.Velocity("left", 6.0))  # rad/s at the output shaft, until another command comes
    for tick in session.run(seconds=2):
        for note in tick.outputs.notes:
            print(f"{tick.seconds:.3f} {note.source}: {note.text}")
    left = session.joints["left"]
    print(f"left: {left.mode}, {left.feedback.position:.2f} rad")
