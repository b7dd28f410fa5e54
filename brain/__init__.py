"""The robot's brain: perception, planning and control, as one pure step function.

Exports nothing here (so that importing one module stays cheap); the entry points are
`brain.brain.Brain` (step: events and tasks in, one command per motor out), `brain.settings.BrainSettings`
and the values of `brain.belief`.

Must not import: anything of `gateway`, and of `protocols` only `messages` and `bounds`. No clock, no I/O, no
vendor, bus or device protocol.
"""
