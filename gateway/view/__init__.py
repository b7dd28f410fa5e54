"""The live view: one port that a browser opens, polled by the loop. Read-only unless it may steer.

What a client asks is an operator's request: a line of the operator's language, part of the next tick, hence
recorded, replayed, limited and guarded. `page/` has the page itself, and the plotting library uPlot with its
licence. Must not import: `gateway.cli`, `gateway.runtime`.
"""

from gateway.view.access import Access as Access
from gateway.view.access import Address as Address
from gateway.view.access import parse_address as parse_address
from gateway.view.scene import Scene as Scene
from gateway.view.server import place as place
from gateway.view.view import View as View
