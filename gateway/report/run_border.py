"""What one part of a version of the program is given and makes: a script, run with that version's rooms.

    python -P run_border.py INPUTS VALUES PART     # PYTHONPATH: the folder that has the rooms of the version

Rules. It knows of the version only that a recording is read, a step done, and that a brain asks its limbs for
plans and commands. Into VALUES it writes a line of JSON for each step: of what the part was given, and of
what it has made, the values that are not as in the step before, by name, and the names that are gone. It
answers with a line of JSON: the number of steps, or an "error". A step that fails is the last.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from hashlib import blake2b
from pathlib import Path
from typing import Any

Values = dict[str, Any]
"""Numbers, texts and choices by name"""


class Flat:
    """Makes names and plain values of values."""

    def __init__(self) -> None:
        self._maps: dict[int, tuple[int, dict[Any, int]]] = {}
        """By map: its version up to which it was looked at, and a digest of each tile"""

    def of(self, name: str, value: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 -- of another version
        """Yield each number, text or choice in a value by its name; of a map a digest, of no function."""
        value = value.tolist() if hasattr(value, "tolist") else value
        if callable(value):
            return
        if hasattr(value, "changed") and hasattr(value, "tile"):
            yield inner(name, "digest"), self._digest(value)
        elif is_dataclass(value):
            for each in fields(value):
                yield from self.of(inner(name, each.name), getattr(value, each.name))
        elif isinstance(value, Mapping):
            for key, each in value.items():
                yield from self.of(inner(name, key), each)
        elif isinstance(value, list | tuple):
            yield inner(name, "number"), len(value)
            for place, each in enumerate(value):
                yield from self.of(f"{name}[{place}]", each)
        else:
            plain = value is None or (isinstance(value, float | int | str) and not isinstance(value, Enum))
            yield name, value if plain else str(value)

    def _digest(self, tiles: Any) -> str:  # noqa: ANN401 -- of another version
        since, digests = self._maps.get(id(tiles), (-1, {}))
        if since != tiles.version:
            for place in tiles.changed(since):
                tile = tiles.tile(*place)
                held = b"" if tile is None else tile.tobytes()
                digests[place] = int.from_bytes(blake2b(repr(place).encode() + held, digest_size=6).digest())
            self._maps[id(tiles)] = tiles.version, digests
        return f"{sum(digests.values()) % (1 << 48):012x}"


def inner(name: str, key: object) -> str:
    """Return the name of a value in another."""
    return f"{name}{': ' if ':' not in name else '.'}{key}" if name else str(key)


class Handed:
    """What the limbs of a brain were handed last, and what they have made of it."""

    def __init__(self, brain: Any) -> None:  # noqa: ANN401 -- of another version
        self.percepts: Values = {}
        self.allowances: Values = {}
        self.plans: Values = {}
        self.commands: Values = {}
        limbs = vars(brain).get("_limbs")
        if not limbs:
            raise ValueError("its brain has no limbs between which could be looked")
        limbs.update({name: _Limb(name, limb, self) for name, limb in limbs.items()})


class _Limb:
    """In the place of a limb: what goes through it is kept."""

    def __init__(self, name: str, limb: Any, handed: Handed) -> None:  # noqa: ANN401 -- of another version
        self._name, self._limb, self._handed = name, limb, handed

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 -- of another version
        return getattr(self._limb, name)

    def plan(self, percept: Any, allowance: Any, **more: Any) -> Any:  # noqa: ANN401 -- of another version
        handed, name = self._handed, self._name
        handed.percepts[name], handed.allowances[name] = percept, allowance
        handed.plans[name] = plan = self._limb.plan(percept, allowance, **more)
        return plan

    def commands(self, *given: Any) -> Any:  # noqa: ANN401 -- of another version
        commands = self._limb.commands(*given)
        self._handed.commands.update((one.motor, one) for one in commands)
        return commands


def guard_alone(robot: Any, began: int) -> Callable[[Any], tuple[Values, Values]]:  # noqa: ANN401 -- as above
    """Return what gives of a tick the frames in it, and for each why the guard would block it, or "no"."""
    from gateway.monitor.allowed import GuardOnly
    from gateway.recording.tick_codec import packet_text

    alone, found = GuardOnly(robot, began), list[Any]()
    guard = vars(alone)["_guard"]
    check = guard.check

    def checked(*given: Any, **more: Any) -> Any:  # noqa: ANN401 -- of another version
        answer = check(*given, **more)
        found.extend(answer[1])
        return answer

    guard.check = checked

    def take(tick: Any) -> tuple[Values, Values]:  # noqa: ANN401 -- of another version
        given: Values = {}
        blocked: Values = {}
        for place, packet in enumerate((*tick.inputs.packets, *tick.outputs.packets)):
            given[f"frame {place}"] = text = f"{packet.bus} {packet_text(packet)}"
            alone.take(packet)
            blocked[f"blocked {text}"] = "; ".join(one.text for one in found) or "no"
            found.clear()
        return given, blocked

    return take


def part_alone(gateway: Any, part: str) -> Callable[[Any], tuple[Values, Values]]:  # noqa: ANN401 -- as above
    """Return what gives of a tick what a part of a gateway was given, and what it has made."""
    from gateway.core.guard import decoder_of
    from gateway.recording.tick_codec import packet_text

    handed = Handed(gateway.brain)
    decoders = {bus: decoder_of(gateway.robot, bus) for bus in gateway.robot.buses}

    def sent(tick: Any) -> Values:  # noqa: ANN401 -- of another version
        texts: dict[str, list[str]] = {}
        obeyed: Values = {}
        for packet in tick.outputs.packets:
            texts.setdefault(packet.bus, []).append(packet_text(packet))
            for each in decoders[packet.bus].decode(packet.t, packet.frame):
                obeyed[f"{getattr(each, 'motor', packet.bus)}: obeys {type(each).__name__}"] = each
        return obeyed | {"frames": texts}

    flat = Flat()

    def take(tick: Any) -> tuple[Values, Values]:  # noqa: ANN401 -- of another version
        events, percepts = {"events": tick.outputs.events}, handed.percepts
        planned = handed.allowances, handed.plans
        sides: dict[str, tuple[Any, Any]] = {
            "perception": ((events,), (percepts,)),
            "planning": ((percepts,), planned),
            "control": ((percepts, *planned), (handed.commands,)),
        }
        driver = ((handed.commands,), (events, sent(tick)))
        given, made = (
            {name: value for each in side for name, value in flat.of("", each)}
            for side in sides.get(part, driver)
        )
        return given, made

    return take


def changes(before: Values, now: Values) -> tuple[Values, list[str]]:
    """Return what is not as before, and what is not there any more."""
    other = {name: value for name, value in now.items() if name not in before or before[name] != value}
    return other, [name for name in before if name not in now]


def run(inputs: str, values: str, part: str) -> dict[str, Any]:
    """Run the inputs of a recording; write what a part was given and has made."""
    from gateway.config import parse_robot
    from gateway.core.step import Gateway
    from gateway.core.tick import Tick
    from gateway.recording import read_recording

    recording = read_recording(inputs)
    robot = parse_robot(recording.robot_text, "robot.toml")
    gateway = Gateway(robot)
    began = next((tick.now for tick in recording.ticks), 0)
    take = guard_alone(robot, began) if part == "guard" else part_alone(gateway, part)
    before: tuple[Values, Values] = ({}, {})
    ticks = 0
    with Path(values).open("w", encoding="utf-8") as file:
        for tick in recording.ticks:
            made, failed = tick, ""
            try:
                if part != "guard":
                    outputs = gateway.step(tick.now, tick.inputs)
                    made = Tick(tick.number, tick.now, tick.inputs, outputs)
                now = take(made)
            except Exception as failure:  # noqa: BLE001 -- it is what this version makes of it
                failed = f"{type(failure).__name__}: {failure}"
                now = before[0], before[1] | {"step": f"fails: {failed}"}
            lines = [changes(*pair) for pair in zip(before, now, strict=True)]
            file.write(json.dumps(lines) + "\n")
            before, ticks = now, ticks + 1
            if failed:
                break
    return {"ticks": ticks}


if __name__ == "__main__":
    try:
        answer = run(*sys.argv[1:])
    except Exception as error:  # noqa: BLE001 -- of another version: it is told
        answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), flush=True)
