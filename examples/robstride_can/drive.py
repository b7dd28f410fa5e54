"""Turn the shoulder by its robot file, and record it."""

import gateway as gw

with gw.open_session("arm.toml", simulated=True, record="arm.mcap") as session:
    for tick in session.run(seconds=2):
        if tick.number == 100:
            session.submit(gw.Position("shoulder", 1.5))
    print(f"shoulder: {session.joints['shoulder'].feedback.position:.2f} rad")
