"""Listening to buses: which devices are there, what they send, what they are commanded.

Read in this order: `state` (what is known), `candidates` (which devices may be there), `decoder` (packets
into state), `sources` (where packets come from), `render` (state as text). Nothing here can send.
Must not import the command line or the runtime.
"""
