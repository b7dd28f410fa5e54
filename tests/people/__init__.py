"""People on foot against the whole brain in the doorway of the office: `python -m tests.people SEED…`."""

from __future__ import annotations
