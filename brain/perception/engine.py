"""The filter's linear algebra, in two engines that give the same numbers.

Rules. A state is 8 numbers, its covariance the 36 numbers of the lower triangle by rows; both are tuples that
are never changed. STRUCTURED is written out in floats where nearly every factor is 0 or 1, and else corrects
by an innovation whitened by the Cholesky factor of its covariance. FILTERPY gives the same matrices to
`predict` and `update` of `filterpy.kalman`. The mean of a prediction is the caller's: its arcs are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from brain.belief import Floats

X, Y, YAW, BIAS, SCALE, LEFT, RIGHT, TURN = range(8)
SIZE = 8
Vector: TypeAlias = tuple[float, ...]
"""x, y, yaw; gyro bias; distance scale; turn slip of the left and the right wheel; angle of the gyro less
that of the wheels."""
Packed: TypeAlias = tuple[float, ...]
"""Lower triangle of a 8 × 8 covariance, by rows."""
Result: TypeAlias = tuple[Vector, Packed, float]
"""State and covariance after an update, and the squared Mahalanobis distance of its innovation."""
LOWER = np.tril_indices(SIZE)
UPPER = LOWER[::-1]
AT = tuple(tuple(max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for j in range(SIZE)) for i in range(SIZE))
"""Index of a pair of states in the lower triangle."""


def unpacked(packed: Packed) -> Floats:
    """Return the whole 8 × 8 matrix."""
    P = np.empty((SIZE, SIZE))
    P[LOWER] = packed
    P[UPPER] = packed
    return P


def pose_part(packed: Packed) -> Floats:
    """Return the covariance of x, y and yaw, 3 × 3."""
    xx, yx, yy, hx, hy, hh = packed[:6]
    return np.array([[xx, yx, hx], [yx, yy, hy], [hx, hy, hh]])


def pack(P: Floats) -> Packed:
    """Return the lower triangle of a symmetric matrix."""
    packed: list[float] = ((P + P.T) / 2.0)[LOWER].tolist()
    return tuple(packed)


class MoveErrors(NamedTuple):
    """What one travel does to errors: derivatives of the new state by the old one, and noise."""

    yaw_x: float
    """d x / d yaw, and so on"""
    yaw_y: float
    scale_x: float
    scale_y: float
    turn_x: float
    turn_y: float
    left_yaw: float
    """d yaw / d slip of the left wheel; d turn as well, and d x, d y through the turn"""
    right_yaw: float
    dt: float
    """s: d turn / d bias"""
    keep_left: float
    """d slip / d slip"""
    keep_right: float
    noise_xx: float
    noise_xy: float
    noise_yy: float
    noise_bias: float
    noise_scale: float
    noise_left: float
    """Of the slip's walk, which turns the base already within the travel: by 1/2 in covariance, 1/3 in
    variance"""
    noise_right: float
    noise_turn: float
    noise_lag: float
    """rad²: of the turn, anew in each travel"""


def matrices(move: MoveErrors) -> tuple[Floats, Floats]:
    """Return the matrices F and Q of a travel."""
    ax, ay, cx, cy, wx, wy, tl, tr, dt, kl, kr, qxx, qxy, qyy, qb, qs, ql, qr, qg, qk = move
    F = np.eye(SIZE)
    turned = np.array([wx, wy, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    F[:, LEFT], F[:, RIGHT] = tl * turned, tr * turned
    F[X, [YAW, SCALE]], F[Y, [YAW, SCALE]] = (ax, cx), (ay, cy)
    F[LEFT, LEFT], F[RIGHT, RIGHT], F[TURN, BIAS] = kl, kr, dt
    Q = np.diag([qxx, qyy, 0.0, qb, qs, ql, qr, qg])
    Q[X, Y] = Q[Y, X] = qxy
    Q += qk * np.outer(turned, turned)
    for slip, by, noise in ((LEFT, tl, ql), (RIGHT, tr, qr)):
        Q += noise / 3.0 * by * by * np.outer(turned, turned)
        Q[slip] += noise / 2.0 * by * turned
        Q[:, slip] += noise / 2.0 * by * turned
    return F, Q


class Engine(Protocol):
    """The three operations."""

    def predict(self, packed: Packed, move: MoveErrors) -> Packed:
        """Return the covariance after a travel."""

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN."""

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by a measurement of these states with innovations y and a noise of m × m."""


class Structured:
    """Plain floats."""

    def predict(self, packed: Packed, move: MoveErrors) -> Packed:
        """Return the covariance after a travel: F P F' + Q, written out."""
        (
            xx, yx, yy, hx, hy, hh, bx, by, bh, bb, sx, sy, sh, sb, ss, lx, ly, lh, lb, ls, ll,
            rx, ry, rh, rb, rs, rl, rr, gx, gy, gh, gb, gs, gl, gr, gg,
        ) = packed  # fmt: skip
        ax, ay, cx, cy, wx, wy, tl, tr, dt, kl, kr, qxx, qxy, qyy, qb, qs, ql, qr, qg, qk = move
        # T: row of the turn by slip; X, Y, H, G: rows of F P
        Th, Tb, Ts = tl * lh + tr * rh, tl * lb + tr * rb, tl * ls + tr * rs
        Tl, Tr, Tg = tl * ll + tr * rl, tl * rl + tr * rr, tl * gl + tr * gr
        Xh = hx + ax * hh + cx * sh + wx * Th
        Xb = bx + ax * bh + cx * sb + wx * Tb
        Xs = sx + ax * sh + cx * ss + wx * Ts
        Xl = lx + ax * lh + cx * ls + wx * Tl
        Xr = rx + ax * rh + cx * rs + wx * Tr
        Xg = gx + ax * gh + cx * gs + wx * Tg
        Xt = tl * Xl + tr * Xr
        Yh = hy + ay * hh + cy * sh + wy * Th
        Yb = by + ay * bh + cy * sb + wy * Tb
        Ys = sy + ay * sh + cy * ss + wy * Ts
        Yl = ly + ay * lh + cy * ls + wy * Tl
        Yr = ry + ay * rh + cy * rs + wy * Tr
        Yg = gy + ay * gh + cy * gs + wy * Tg
        Yt = tl * Yl + tr * Yr
        Tx, Ty = tl * lx + tr * rx, tl * ly + tr * ry
        Hb, Hl, Hr = bh + Tb, lh + Tl, rh + Tr
        Ht = tl * Hl + tr * Hr
        Gb, Gl, Gr = gb + dt * bb + Tb, gl + dt * lb + Tl, gr + dt * rb + Tr
        # noise: the slips' walks turn the base within the travel, too
        ml, mr = 0.5 * tl * ql, 0.5 * tr * qr
        qt = (tl * tl * ql + tr * tr * qr) / 3.0 + qk
        qx, qy = wx * qt, wy * qt
        return (
            xx + ax * hx + cx * sx + wx * Tx + ax * Xh + cx * Xs + wx * (Xt + qx) + qxx,
            yx + ax * hy + cx * sy + wx * Ty + ay * Xh + cy * Xs + wy * (Xt + qx) + qxy,
            yy + ay * hy + cy * sy + wy * Ty + ay * Yh + cy * Ys + wy * (Yt + qy) + qyy,
            Xh + Xt + qx, Yh + Yt + qy, hh + Th + Ht + qt,
            Xb, Yb, Hb, bb + qb,
            Xs, Ys, sh + Ts, sb, ss + qs,
            kl * Xl + wx * ml, kl * Yl + wy * ml, kl * Hl + ml, kl * lb, kl * ls, kl * kl * ll + ql,
            kr * Xr + wx * mr, kr * Yr + wy * mr, kr * Hr + mr, kr * rb, kr * rs,
            kl * kr * rl, kr * kr * rr + qr,
            Xg + dt * Xb + Xt + qx, Yg + dt * Yb + Yt + qy, gh + Tg + dt * Hb + Ht + qt,
            Gb, gs + dt * sb + Ts, kl * Gl + ml, kr * Gr + mr,
            gg + dt * gb + Tg + dt * Gb + tl * Gl + tr * Gr + qt + qg,
        )  # fmt: skip

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN: one division, and no matrix."""
        (
            xx, yx, yy, hx, hy, hh, bx, by, bh, bb, sx, sy, sh, sb, ss, lx, ly, lh, lb, ls, ll,
            rx, ry, rh, rb, rs, rl, rr, gx, gy, gh, gb, gs, gl, gr, gg,
        ) = packed  # fmt: skip
        S, d = gg + variance, innovation
        kx, ky, kh, kb, ks, kl, kr = gx / S, gy / S, gh / S, gb / S, gs / S, gl / S, gr / S
        x0, x1, x2, x3, x4, x5, x6, x7 = x
        state = (
            x0 + kx * d, x1 + ky * d, x2 + kh * d, x3 + kb * d, x4 + ks * d, x5 + kl * d, x6 + kr * d,
            x7 + gg / S * d,
        )  # fmt: skip
        kg = variance / S
        covariance = (
            xx - kx * gx, yx - ky * gx, yy - ky * gy, hx - kh * gx, hy - kh * gy, hh - kh * gh,
            bx - kb * gx, by - kb * gy, bh - kb * gh, bb - kb * gb,
            sx - ks * gx, sy - ks * gy, sh - ks * gh, sb - ks * gb, ss - ks * gs,
            lx - kl * gx, ly - kl * gy, lh - kl * gh, lb - kl * gb, ls - kl * gs, ll - kl * gl,
            rx - kr * gx, ry - kr * gy, rh - kr * gh, rb - kr * gb, rs - kr * gs, rl - kr * gl, rr - kr * gr,
            kg * gx, kg * gy, kg * gh, kg * gb, kg * gs, kg * gl, kg * gr, kg * gg,
        )  # fmt: skip
        return state, covariance, d * d / S

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by the whitened innovation: the covariance stays symmetric."""
        P = unpacked(packed)
        columns = P.take(rows, axis=1)
        white = np.linalg.inv(np.linalg.cholesky(columns.take(rows, axis=0) + noise))
        gain, innovation = columns @ white.T, white @ y
        shift, distance = gain @ innovation, float(innovation @ innovation)
        corrected = tuple(a + b for a, b in zip(x, shift.tolist(), strict=True))
        return corrected, tuple((P - gain @ gain.T)[LOWER].tolist()), distance


class Filterpy:
    """`filterpy.kalman` on the same numbers."""

    def __init__(self) -> None:
        from filterpy import kalman  # here, because it takes seconds to import

        self._predict: Any = kalman.predict
        self._update: Any = kalman.update

    def predict(self, packed: Packed, move: MoveErrors) -> Packed:
        """Return the covariance after a travel."""
        F, Q = matrices(move)
        return pack(self._predict(np.zeros(SIZE), unpacked(packed), F, Q)[1])

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN."""
        return self.update(x, packed, (TURN,), (innovation,), np.array([[variance]]))

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by a measurement of these states."""
        H, P, innovation = np.eye(SIZE)[list(rows)], unpacked(packed), np.array(y)
        shift, after = self._update(np.zeros(SIZE), P, innovation, noise, H)
        corrected = tuple(a + b for a, b in zip(x, shift.tolist(), strict=True))
        return corrected, pack(after), float(innovation @ np.linalg.solve(H @ P @ H.T + noise, innovation))


def cross_zeroed(packed: Packed, state: int, variance: float) -> Packed:
    """Return a covariance in which one state has this variance and no correlation."""
    new = list(packed)
    for other in range(SIZE):
        new[AT[state][other]] = 0.0
    new[AT[state][state]] = variance
    return tuple(new)


TINY = 1e-12 * np.eye(3)


def relative(packed: Packed, rows: Sequence[int], shared: Floats) -> tuple[Packed, Floats]:
    """Split a covariance into what is relative to a map and the map's own share, 8 × 8.

    The map was drawn from the estimate: pose error = map error + error relative to the map, and only the
    latter shows in a match. `shared` is the map's covariance; it counts up to the pose's own, and explains
    the errors of the other states in proportion to the pose's."""
    P = unpacked(packed)
    columns = P.take(rows, axis=1)
    inverse = np.linalg.inv(np.linalg.cholesky(columns.take(rows, axis=0) + TINY[: len(rows), : len(rows)]))
    values, vectors = np.linalg.eigh(inverse @ (shared + shared.T) @ (0.5 * inverse.T))
    part = columns @ (inverse.T @ vectors)
    share: Floats = (part * np.minimum(np.maximum(values, 0.0), 1.0)) @ part.T
    return pack(P - share), share


ENGINES: dict[str, type[Structured] | type[Filterpy]] = {"structured": Structured, "filterpy": Filterpy}
