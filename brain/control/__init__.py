"""Control: from a path to a twist within the limits of the base.

Exports: `motion.MotionControl` (all of it for a base), `pursuit.Pursuit` (path following), `track.runs` (a
path as it is driven), `profile.approach` (acceleration and jerk).
Must not import: perception; of planning, only `polyline`. Nothing of it is imported by the gateway.
"""
