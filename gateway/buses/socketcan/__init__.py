"""CAN interfaces of the Linux kernel, "socketcan:can0": the bus and its raw socket.

Opened by `gateway.buses.open_bus`. Knows no protocol; imports nothing of the gateway but core and buses.
"""
