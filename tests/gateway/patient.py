"""`python -m tests.gateway.patient …`: `gateway …` that gives devices a minute to report themselves disarmed.

They are another process in these tests, which may have no processor in the half second that real ones get;
nor may it have any while a real one would arm."""

from __future__ import annotations

import os
import sys

from gateway.cli.main import main
from protocols.messages import SECOND


def be_patient() -> None:
    """Do so in this process."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does, before its imports
    from gateway.core import arming
    from gateway.runtime import loop
    from protocols.toolkit import host

    host.ATTEMPTS = 10_000
    arming.DISARMING = loop.DISARM_TIMEOUT = 60 * SECOND


if __name__ == "__main__":
    be_patient()
    sys.exit(main())
