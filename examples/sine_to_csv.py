"""A joint along a sine, 100 times a second, and what it did: sine_to_csv.py [FILE.csv [FILE.png]]."""

import sys
from dataclasses import replace
from math import cos, pi

import numpy as np

import gateway as gw

FILES = sys.argv[1:] or ["sine.csv"]
AMPLITUDE, HZ = 0.5, 0.5  # rad, 1/s
robot = replace(gw.load_robot("bench"), period=10_000_000)  # ns: 100 steps a second
session = gw.open_session(robot, simulated=True)
log = session.log()
for tick in session.run(seconds=6):
    session.submit(gw.Velocity("left", AMPLITUDE * 2 * pi * HZ * cos(2 * pi * HZ * tick.seconds)))
session.close()

turned, asked = log["left.position"], log["left.command.velocity"]
print(f"{len(log)} rows, {np.nanmax(turned) - np.nanmin(turned):.2f} rad, at {np.nanmax(asked):.2f} rad/s")
log.to_csv(FILES[0])
if len(FILES) > 1:
    import matplotlib.pyplot as plt

    plt.plot(log.t, turned, label="position [rad]")
    plt.plot(log.t, log["left.velocity"], label="velocity [rad/s]")
    plt.xlabel("t [s]")
    plt.legend()
    plt.savefig(FILES[1])
