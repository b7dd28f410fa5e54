"""CAN interfaces of the Linux kernel, "socketcan:can0": the bus, its raw socket, and the kernel's link state.

Opened by `gateway.buses.open_bus`. Knows no protocol; imports nothing of the gateway but core and buses.
"""
