"""The whole brain against a fast kinematic base in varied worlds: `python -m tests.robustness`.

`plant` is base, sensors and surroundings, `judge` drives the brain through one case and measures it,
`variations` is the table of cases. No test here judges the wall clock.
"""

from __future__ import annotations
