"""CAN adapters with an ASCII protocol on a serial line (slcan, fdcanusb), both ends.

`slcan`, `fdcanusb`: the line formats and an emulated adapter, pure; `slcan_client`, `fdcanusb_client`: the
host's end, as interfaces of python-can; `pty`, `adapter_pty`: simulated buses offered to other programs on
pseudo-terminals. Knows no protocol of a device; imports nothing of the gateway but core and buses.
"""
