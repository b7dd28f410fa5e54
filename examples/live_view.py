"""Look at a run in a browser: map, joints, buses; the address is printed. Real time, ten seconds."""

import gateway as gw

with gw.open_session("diffbot") as session:
    print("open", session.view("0", steer=True))  # port 0: one that is free
    session.submit(gw.Goal(x=1.0, y=0.5))
    for tick in session.run(seconds=10):
        for note in tick.outputs.notes:
            print(f"{tick.seconds:.3f} {note.source}: {note.text}")
    print(session.pose)
