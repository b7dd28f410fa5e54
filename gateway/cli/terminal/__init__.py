"""The terminal of interactive commands: `keys` reads it, `screen` draws on it, `progress`
shows how far long work is, `output` writes without waiting for it.

Exports nothing at this level. Imports nothing of the gateway but how texts are escaped, and
the stopwatch.
"""
