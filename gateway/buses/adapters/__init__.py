"""CAN adapters with a protocol of their own on a serial line (slcan, fdcanusb, dm-serial), both ends.

`slcan`, `fdcanusb`, `dm_serial`: the formats and an emulated adapter, pure; `slcan_client` …: the host's end,
as interfaces of python-can; `pty`, `adapter_pty`: simulated buses offered to other programs on
pseudo-terminals. Knows no protocol of a device; imports nothing of the gateway but core and buses.
"""
