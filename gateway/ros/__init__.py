"""The robot in ROS 2's graph, without ROS: topics, services, parameters and actions, by RTPS of our own.

What comes from the graph is an operator's request: an instruction of the next tick, hence recorded, replayed,
limited and guarded, and below a person. The loop writes to a pipe and reads from it, and never waits: a
process of its own (`process`) has the sockets, and speaks with other participants (`rtps`, which knows no
socket). Must not import: `gateway.cli`, `gateway.runtime`.
"""
