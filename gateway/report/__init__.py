"""A report of a run: one HTML file with map, plots, figures and log, which opens without a network.

Exports: `write_report` and `draw_map` (of a recording), `Collector` (fed with every tick), `Facts`, `write`,
`versions`.
Must not import: `gateway.runtime`, `gateway.cli`. Nothing here moves a robot.

Rules. One collector serves a run and a replay. What it keeps is bounded, however long the run is: signals as
the lowest and highest value in each of a bounded number of intervals, paths by thinning, notes by number.
Texts of others (names, notes, reasons) get into the page escaped only, and the page's own policy lets no
other script run.
"""

from gateway.report.collect import Collector
from gateway.report.page import Facts, write
from gateway.report.recorded import draw_map, versions, write_report

__all__ = ["Collector", "Facts", "draw_map", "versions", "write", "write_report"]
