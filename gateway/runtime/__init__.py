"""The loops on a clock, and what a process needs around them.

`session.open_session` opens everything that a live run needs; `loop.live` steps the gateway on buses,
`serve.serve` simulates the devices for another program; `process` has signals, `realtime` priority, `timing`
how a loop keeps its time. The third loop over the same step is replay (gateway.replay), which needs neither
clock nor bus.
Exports nothing at this level, so that the watchdog process (`watchdog_process`) imports what it needs alone.
Must not import the operator, the monitor or the command line.
"""
