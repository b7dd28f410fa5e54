"""Robot bodies, one file each: exact kinematics both ways, limits, footprint, stopping distance.

Exports: `differential.Differential` (a base on two driven wheels), `joints.Joints` (bare motors).
Must not import: perception, planning, control, nor numpy.
"""
