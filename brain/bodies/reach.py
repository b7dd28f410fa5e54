"""Inverse kinematics: a search for joint positions that bring a chain's tip to a place.

Rules. Damped least squares within the joints' ranges, from where the joints are, and then from places spread
evenly over their ranges: the work is bounded, and a call does a counted part of it. Deterministic; state is
plain data. Where nothing is found the reason is given, with how near it came.

Sources: Sugihara 2011, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method" (the
damping is the error itself, and a constant); Halton 1960 (even spreading).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from brain.bodies.chain import Array, Chain, rotation_vector

CLOSE, CLOSE_TURN = 1e-4, 1e-3
"""m and rad: a place is reached that is as near"""
BIAS = 1e-4
"""Constant part of the damping [m²]"""
LEVER = 0.3
"""m per rad: what an error of attitude counts beside one of place"""
PER_START, STARTS = 60, 25
"""Most iterations from one place, and places"""
STALLED, GAIN = 10, 0.9
"""A search that has not come nearer by this share within as many iterations goes on from another place."""
LONGEST = 0.5
"""rad or m that a joint moves at most in one iteration"""
PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


class ReachSearch:
    """One search. `place`: m, in the base's frame; `attitude`: the tip's rotation, None if any will do.

    `fixed` are joints that keep their positions."""

    def __init__(
        self,
        chain: Chain,
        start: Sequence[float],
        place: Sequence[float],
        attitude: Array | None = None,
        fixed: Sequence[int] = (),
    ) -> None:
        self._chain, self._place, self._attitude = chain, np.array(place, dtype=float), attitude
        self._from = np.array(start, dtype=float)
        self._q = np.clip(self._from, chain.low, chain.high)
        self._free = np.ones(len(start))
        self._free[list(fixed)] = 0.0
        self._starts = self._iterations = self._since = 0
        self._least = math.inf
        self._best = math.inf, math.inf
        """Error of place [m] and of attitude [rad] where it came nearest."""
        self.done = False
        self.found: tuple[float, ...] | None = None
        self.why = ""
        """Why nothing was found."""

    def advance(self, iterations: int) -> bool:
        """Do some of the work; return whether it is done."""
        for _ in range(iterations):
            if self.done:
                break
            self._iterate()
        return self.done

    def _iterate(self) -> None:
        """Do one iteration."""
        (turned, place), jacobian = self._chain.jacobian(self._q)
        error = self._place - place
        near, turn = float(np.sqrt(error @ error)), 0.0
        rows = jacobian[:3]
        if self._attitude is not None:
            about = rotation_vector(self._attitude @ turned.T)
            turn = float(np.sqrt(about @ about))
            error, rows = np.concatenate((error, LEVER * about)), jacobian * _WEIGHTS
        if near + LEVER * turn < self._best[0] + LEVER * self._best[1]:
            self._best = near, turn
        if near <= CLOSE and turn <= CLOSE_TURN:
            self._finish()
            return
        square = float(error @ error)
        if square < GAIN * self._least:
            self._least, self._since = square, 0
        self._since += 1
        self._iterations += 1
        if self._since > STALLED or self._iterations > PER_START:
            self._restart()
            return
        slope = rows.T @ error
        pressed = ((self._q <= self._chain.low) & (slope < 0.0)) | (
            (self._q >= self._chain.high) & (slope > 0.0)
        )
        free = self._free * ~pressed
        moved = rows * free
        damped = moved.T @ moved + (0.5 * square + BIAS) * np.eye(len(free))
        step = np.linalg.solve(damped, slope * free)
        step *= min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-12))
        self._q = np.clip(self._q + step, self._chain.low, self._chain.high)

    def _finish(self) -> None:
        self.done = True
        around = np.where(np.isinf(self._chain.low), 2.0 * np.pi, np.inf)  # the nearest of the same angles
        turns = np.where(np.isinf(around), 0.0, np.round((self._from - self._q) / around))
        whole = np.where(np.isinf(around), 0.0, turns * 2.0 * np.pi)
        self.found = tuple((self._q + whole).tolist())

    def _restart(self) -> None:
        self._starts += 1
        self._iterations = self._since = 0
        self._least = math.inf
        if self._starts < STARTS:
            low = np.where(np.isinf(self._chain.low), -np.pi, self._chain.low)
            high = np.where(np.isinf(self._chain.high), np.pi, self._chain.high)
            share = np.array([_halton(self._starts, PRIMES[i % len(PRIMES)]) for i in range(len(low))])
            self._q = np.where(self._free > 0.0, low + (high - low) * share, self._q)
            return
        self.done = True
        near, turn = self._best
        x, y, z = self._place
        self.why = f"({x:.3g}, {y:.3g}, {z:.3g}) is out of reach: it comes no nearer than {near:.3f} m"
        if self._attitude is not None:
            self.why += f" and {math.degrees(turn):.0f}° in this attitude"


_WEIGHTS: Array = np.array([[1.0], [1.0], [1.0], [LEVER], [LEVER], [LEVER]])


def _halton(index: int, base: int) -> float:
    """Return a member of the Halton sequence, from 0 to 1."""
    share, result = 1.0 / base, 0.0
    while index:
        index, digit = divmod(index, base)
        result += digit * share
        share /= base
    return result
