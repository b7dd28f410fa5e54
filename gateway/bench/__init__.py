"""Before a robot drives: a base calibrated, a motor tuned, what hinders it named: by measuring. And what a
recording asks, driven again.

Must not import: gateway.cli. What is estimated comes from events alone, so that a drive that is under way, a
recording and another program's bag are read alike. What moves a robot is a session (`gateway.runtime`), with
its limits and its guard.
"""
