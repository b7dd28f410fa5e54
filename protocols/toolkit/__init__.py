"""Machinery that protocols share. Third parties use it too, and nobody must: the contract tests what a plugin
does, not how it is made.

    table           messages as a table: codec, names, ids, ranges and read-only from one declaration
    serial          framing of a byte stream, and its checksums
    packets         messages on such a stream as a table; who obeys them: decoder and firmware
    masked          messages whose fields are chosen by the bits of a mask
    host            the host's record of a device: phases and what changes them
    motor_driver    the driver of all devices on one bus; a protocol gives it an `Adapter`
    i2c             transfers on an I²C bus, and what comes of them, as bytes
    lines           the adapter of devices on a serial line
    sensors         spec and adapter of sensors that stream on a line of their own
    device_clock    the time that a device stamps its messages with, in ours
    rays            rays of a lidar that turns clockwise → scans
    questions       periods of what is asked now and then
    boards          boards that drive two motors each
    register_motor  the adapter of motors that only answer, and keep their setup in registers
    assembly        spec, driver and decoder of devices with a table
    requests        range checks, refusals, pending requests
    registers       parameters by name, number and type
    memory_map      registers as a map of bytes: of servos on a bus, whose
    servo_packets   packets read and write by address, of one or of several at once;
    servo_driver    their adapter: chains of answers, sync writes, set-up, requests;
    servo_device    and what one keeps and obeys, in decoder and twin
    duplicates      how two devices with one address are noticed
    firmware        the device's side: arming, watchdog, reports, replies
    pulses          hobby servos: what a pulse means, and the servo behind its wire
    servo           encoder, control loops, power stage with supply and heat
    mit             five numbers in every command, as MIT-type actuators have them
    turns           positions beyond the range, or the turn, in which they are reported
    options         parameters of a device that are settings of its twin

Imports the plugin interface (`protocols.messages`, `frames`, `plugin`) and no protocol.
"""

from __future__ import annotations
