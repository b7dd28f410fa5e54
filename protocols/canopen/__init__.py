"""What CANopen devices share (CiA 301): NMT, heartbeat, EMCY, SYNC, SDO, PDO, object dictionary, EDS.

No profile and no device: those are protocols of their own, on top of this. Imports nothing of them.
"""
