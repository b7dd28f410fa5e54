"""Run a recording through the code of today, compared to the byte: replay_a_recording.py FILE.mcap."""

import sys
from collections import Counter

import gateway as gw

recording = gw.read_recording(sys.argv[1])
print(gw.replay_recording(recording).text())

events = Counter(type(event).__name__ for tick in recording.ticks for event in tick.outputs.events)
print("events:", ", ".join(f"{count} {name}" for name, count in events.most_common()))
