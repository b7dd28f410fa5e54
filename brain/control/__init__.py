"""Control: from a path to a twist, within the base's limits.

Exports: `pursuit.Pursuit` (regulated pure pursuit), `profile.approach` (acceleration limits).
Must not import: perception; of planning, only `polyline`.
"""
