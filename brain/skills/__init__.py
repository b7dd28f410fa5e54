"""Skills: a mission's steps, one file each: how it is read, what is wrong with it, its text, how it is done.

Exports: `skill.Skill`, of which each file makes one; `found`, which finds them by their entry points (group
"motor_gateway.skills"), other distributions' too; `measured`, what motions share. Steps that hold others
(Repeat, Try) are unrolled by `brain.planning.missions`.
Must not import: perception, planning, control.
"""
