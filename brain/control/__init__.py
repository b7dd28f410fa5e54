"""Control: from a path to a twist, and to one command per joint, within the limits of base and joints.

Exports: `motion.MotionControl` (all of it for a base), `pursuit.Pursuit` (path following), `track.runs` (a
path as it is driven), `profile.approach` (acceleration and jerk), `joint_profile.synchronised` (joints).
Must not import: perception; of planning, only `polyline`.
"""
