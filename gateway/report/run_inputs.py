"""What a version of the program makes of inputs: a script, run with that version's rooms before others.

    python -P run_inputs.py        # PYTHONPATH: the folder that has the rooms of the version

Rules. It knows of the version only what has long been the same: how a recording is read and written, and the
step. It takes a line of JSON for each run from standard input, {"inputs": FILE, "outputs": FILE, "signals":
FILE}, and answers with one: a digest of the packets of each step, or why there is none. A step that fails
ends the run. The first line that it writes tells that it is there.
"""

import json
import sys
from hashlib import blake2b
from pathlib import Path
from typing import Any


def digest(outputs: Any) -> str:  # noqa: ANN401 -- of another version
    """Return a digest of what is sent in a step."""
    made = blake2b(digest_size=6)
    for packet in outputs.packets:
        frame = packet.frame
        kind = (
            "bytes" if isinstance(frame, bytes) else f"{frame.id}/{frame.extended}/{frame.remote}/{frame.fd}"
        )
        made.update(f"{packet.bus} {kind} ".encode() + bytes(getattr(frame, "data", frame)))
    return made.hexdigest()


def run(inputs: str, outputs: str, signals: str) -> dict[str, Any]:
    """Run the inputs of a recording; write what comes of it, if a file is named."""
    import numpy as np

    from gateway.config import parse_robot
    from gateway.core.step import Gateway
    from gateway.core.tick import Tick
    from gateway.recording import environment, read_recording
    from gateway.recording.ros_views import Views
    from gateway.recording.tick_writer import TickWriter
    from gateway.replay.signal_log import SignalLog

    recording = read_recording(inputs)
    robot = parse_robot(recording.robot_text, "robot.toml")
    gateway = Gateway(robot)
    log = SignalLog(gateway)
    facts = {**recording.facts, **environment.facts()}
    mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
    writer = TickWriter(Path(outputs), recording.robot_text, facts, Views(mounts)) if outputs else None
    digests, error = [], ""
    for tick in recording.ticks:
        try:
            made = Tick(tick.number, tick.now, tick.inputs, gateway.step(tick.now, tick.inputs))
        except Exception as failure:  # noqa: BLE001 -- whatever it is, it is what this version makes of it
            error = f"{type(failure).__name__}: {failure}"
            digests.append("failed")
            break
        digests.append(digest(made.outputs))
        belief = gateway.belief()
        log.take(made, belief)
        if writer is not None:
            writer.add(made, belief)
    if writer is not None:
        writer.finish()
    if signals:
        names = list(log.units)
        table = np.array([log[name] for name in names])
        np.savez(signals, t=log.t, names=names, units=[log.units[name] for name in names], table=table)
    return {"digests": digests, "failed": error}


def main() -> None:
    """Do what is asked, line by line."""
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = run(asked["inputs"], asked["outputs"], asked["signals"])
        except Exception as error:  # noqa: BLE001 -- of another version: it is told
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
