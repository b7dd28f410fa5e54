"""Machinery that protocols share. Third parties use it too, and nobody must: the contract tests what a plugin
does, not how it is made.

    table           messages as a table: codec, names, ids, ranges and read-only from one declaration
    serial          framing of a byte stream, and its checksums
    host            the host's record of a device: phases and what changes them
    motor_driver    the driver of all devices on one bus; a protocol gives it an `Adapter`
    register_motor  the adapter of motors that only answer, and keep their setup in registers
    assembly        spec, driver and decoder of devices with a table
    requests        range checks, refusals, pending requests
    registers       parameters by name, number and type
    duplicates      how two devices with one address are noticed
    firmware        the device's side: arming, watchdog, reports, replies
    servo           encoder, control loops, power stage with supply and heat
    mit             five numbers in every command, as MIT-type actuators have them
    turns           positions beyond the range in which they are reported
    options         options and settings with their bounds

Imports the plugin interface (`protocols.messages`, `frames`, `plugin`) and no protocol.
"""

from __future__ import annotations
