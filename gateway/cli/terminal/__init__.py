"""The terminal of interactive commands: `keys` reads it, `screen` draws on it.

Exports nothing at this level. Imports nothing of the gateway but how texts are escaped.
"""
