"""Perception: from the body's events to an estimate of pose and twist, and an occupancy grid.

Exports: `perception.Perception` and `perception.PerceptionSettings` (what the brain uses), `mount.Mount` (a
sensor's extrinsics). Must not import: planning, control.
"""
