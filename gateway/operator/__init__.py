"""The operator of a running robot: a local socket and the terminal, and the commands they take.

Exports Operator, ask, socket_path. Must not import the runtime: instructions are returned to the loop,
which makes them part of the tick.
"""

from __future__ import annotations

from gateway.operator.server import Operator, ask, socket_path

__all__ = ["Operator", "ask", "socket_path"]
