"""The step and its values: `Gateway.step(now, inputs) -> outputs` is everything that a robot does.

    step     Gateway, decoder_of            tick    Inputs, Outputs, Note, Tick
    joint    Joint, JointSettings           robot   Robot, Motor, Sensor, BusSettings
    limits   Limits, Profile
    clock    WallClock, PacedClock, SimulatedClock: the only file that reads the time

Must not import buses, recordings, simulation, operator or runtime. Nothing is imported here: the values and
the clock are also used where the brain and numpy, which `step` needs, are not.
"""
