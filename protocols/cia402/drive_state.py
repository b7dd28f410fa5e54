"""What one drive has reported of its state, and what that is in the gateway's terms.

Source: CiA 402-2 "finite state automaton"; CiA 301 "emergency".
"""

from __future__ import annotations

from typing import NamedTuple

from protocols.cia402 import objects as o
from protocols.cia402 import profile
from protocols.cia402.profile import POWERED, PowerState
from protocols.cia402.setpoints import Values
from protocols.cia402.setup import Known
from protocols.messages import Mode

FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
CALM = (PowerState.NOT_READY, PowerState.SWITCH_ON_DISABLED, PowerState.READY, PowerState.FAULT)
"""States that confirm that it is disarmed."""
READING = "reading its object dictionary"


class JudgedState(NamedTuple):
    """Its state in the gateway's terms."""

    mode: Mode
    detail: str
    first_mode: Mode
    """The mode of a drive that was never commanded: it is not reported as armed before it is known."""
    rests: bool
    """It is armed, or certainly is not."""


class DriveState:
    """What one drive has reported since it began; integers are in its units. Plain data."""

    def __init__(self) -> None:
        self.statusword: int | None = None
        self.power: PowerState | None = None
        self.mode_display: int | None = None
        self.position: int | None = None
        self.reports = 0
        """Statuswords received."""
        self.codes: set[int] = set()
        """Error codes that are active."""
        self.code_wanted = False
        """It is in fault, and the error code is not known."""
        self.emcy = False
        """It sent an EMCY, and no statusword since."""
        self._judged: tuple[int | None, int | None] = None, None
        """The statusword and mode that were judged last."""

    def on_emcy(self, code: int) -> None:
        """Handle an emergency, or the end of one (code 0)."""
        if code:
            self.codes.add(code)
            self.code_wanted, self.emcy = False, True
        else:
            self.forget_codes()

    def forget_codes(self) -> None:
        """Forget the error codes, if it is not in fault."""
        if self.power not in FAULTY:
            self.codes.clear()

    def forget_position(self) -> None:
        """Forget the position: it was given another value."""
        self.position = None

    def take(self, values: Values) -> bool:
        """Store objects of state and motion; return whether its state is to be judged anew."""
        self.mode_display = values.get(o.MODE_DISPLAY, self.mode_display)
        news = False
        if o.STATUSWORD in values:
            news = self._on_statusword(values[o.STATUSWORD])
        self.position = values.get(o.POSITION, self.position)
        if self.code_wanted and values.get(o.ERROR_CODE):
            self.codes.add(values[o.ERROR_CODE])
            self.code_wanted = False
        return news

    def _on_statusword(self, status: int) -> bool:
        self.reports += 1
        self.emcy = False
        if (status, self.mode_display) == self._judged:
            return False
        before, self.statusword, self.power = self.power, status, profile.state_of(status)
        if self.power in FAULTY and before not in FAULTY:
            self.code_wanted = not self.codes
        elif self.power not in FAULTY and before in FAULTY:
            self.code_wanted = False
            self.codes.clear()
        return True

    def judge(self, known: Known, *, stopped: bool) -> JudgedState:
        """Decide what its state is; `stopped`: an operator's stop is in force."""
        power, complete = self.power, known.complete
        self._judged = self.statusword, self.mode_display
        detail = power.value if power is not None else ""
        if power is PowerState.OPERATION_ENABLED and self.mode_display is not None:
            detail += f", {profile.mode_name(self.mode_display)}"
        detail = ", ".join(filter(None, (detail, "" if complete else READING)))
        if known.unusable:
            mode, detail = Mode.FAULT, known.unusable
        elif power in FAULTY or stopped:
            mode = Mode.FAULT
        elif power in POWERED:
            mode = Mode.ARMED
        elif power in (None, PowerState.NOT_READY) or not complete:
            mode = Mode.INITIALISING
        else:
            mode = Mode.READY
        first = mode if complete or known.unusable else Mode.INITIALISING
        return JudgedState(mode, detail, first, power in CALM or mode is Mode.ARMED)

    def in_words(self) -> str:
        """Return power state and mode, as displayed."""
        state = "an unknown state" if self.power is None else self.power.value
        shown = "no mode" if self.mode_display is None else profile.mode_name(self.mode_display)
        return f"{state} with {shown} displayed"
