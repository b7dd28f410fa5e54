"""A serial port as a bus: "serial:/dev/ttyUSB0", "serial:usb-0403:6014:FT7W". Exports nothing.

`bus`: the bus, `open_serial`; `opening`: how a port is opened, and why it cannot be; `echo`: our own bytes
that come back; `garbage`: what a wrong baud rate makes of bytes. The last two are pure.
"""
