"""What a person or a program asks of a running robot: the socket, the terminal, and the commands they take.

Exports Operator, ask, socket_path. Must not import the runtime: what is asked is returned to
the loop, which makes it part of the tick.
"""

from gateway.operator.server import Operator, ask, socket_path

__all__ = ["Operator", "ask", "socket_path"]
