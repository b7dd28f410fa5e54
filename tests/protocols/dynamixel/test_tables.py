"""The control tables, against those of dynamixel-sdk 4.1.0 (`dynamixel_easy_sdk/control_table/*.model`)."""

from __future__ import annotations

import math
import re
from pathlib import Path

import dynamixel_easy_sdk
import pytest

from protocols.dynamixel.table import BY_NUMBER, MODELS, data_of

FOLDER = Path(dynamixel_easy_sdk.__file__).parent / "control_table"
NOT_OURS = {
    "LED_Red", "LED_Green", "LED_Blue", "Indirect_Data_1", "Indirect_Address_Write", "Indirect_Data_Write",
    "Indirect_Address_Read", "Indirect_Data_Read", "Backup_Ready", "Startup_Configuration",
    "Acceleration_Limit",
}  # fmt: skip
OURS = {"Secondary_ID": {"Secondary(Shadow)_ID", "Secondary_ID"}}


def official(name: str) -> tuple[dict[str, str], dict[str, tuple[int, int]], dict[str, float]]:
    """Return the facts of a model file, its registers (address and size), and its units."""
    facts, registers, units, part = dict[str, str](), dict[str, tuple[int, int]](), dict[str, float](), ""
    for line in (FOLDER / f"{name}.model").read_text().splitlines():
        cells = line.strip().split("\t")
        if line.startswith("["):
            part = line.strip("[] \r\n")
        elif part == "type info" and len(cells) == 2:
            facts[cells[0]] = cells[1]
        elif part == "control table" and cells[0].isdigit():
            registers[cells[2].replace(" ", "_")] = int(cells[0]), int(cells[1])
        elif part == "unit info" and len(cells) > 2 and cells[1][0].isdigit():
            units[cells[0].replace(" ", "_")] = float(cells[1])
    return facts, registers, units


def numbers() -> dict[int, str]:
    lines = (FOLDER / "dynamixel.model").read_text().splitlines()
    return {
        int(a): b.removesuffix(".model")
        for a, b in (line.split("\t") for line in lines if line[:1].isdigit())
    }


# The list of the SDK has no XW430-T200, though a file of it.
FILES = {**{BY_NUMBER[n]: f for n, f in numbers().items() if n in BY_NUMBER}, "XW430-T200": "xw430_t200"}


def test_every_model_has_a_file_and_its_number() -> None:
    assert FILES.keys() == MODELS.keys()
    for model, name in FILES.items():
        same = re.sub(r"[^a-z0-9]", "", model.lower())
        assert re.sub(r"[^a-z0-9]", "", name) in (same, re.sub("ph|pm", lambda m: m[0], same))


@pytest.mark.parametrize("model", MODELS)
def test_registers_and_units(model: str) -> None:
    ours, table = MODELS[model], MODELS[model].table
    facts, registers, units = official(FILES[model])
    mine = {
        next((n for n in OURS.get(name, ()) if n in registers), name): (register.number, register.size)
        for name, register in table.by_name.items()
        if not name.startswith("Indirect_Address_") or name.endswith("_1")
    }
    missing = {
        name for name in registers.keys() - mine.keys() - NOT_OURS if not name.startswith("External_Port")
    }
    assert not missing
    # The series have registers that not every model of them has: they are not relied on.
    extra = {"Acceleration_Limit", "LED"}
    assert {name: at for name, at in mine.items() if name not in extra or name in registers} == {
        name: registers[name] for name in mine if name in registers
    }
    assert (ours.zero, units["Present_Velocity"]) == (int(facts["value_of_zero_radian_position"]), ours.step)
    ends = [int(facts[f"value_of_{end}_radian_position"]) for end in ("min", "max")]
    assert ends[1] - ends[0] in (ours.counts, ours.counts - 1)
    assert data_of(ours, 46) == registers["Indirect_Data_1"][0]
    if ours.family == "X330":
        assert data_of(ours, 52) == official(f"{FILES[model]}_fw52")[1]["Indirect_Data_1"][0]
    if 0.0 < (unit := units.get("Present_Current", 1.0)) < 1.0:  # N·m of one step
        assert math.isclose(unit, ours.torque * ours.ampere, rel_tol=0.005)
