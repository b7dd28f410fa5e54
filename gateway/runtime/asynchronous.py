"""A run for an asynchronous program: the robot is stepped in one thread, and each tick is awaited."""

from __future__ import annotations

import asyncio  # of the caller: nothing of ours is asynchronous
from collections.abc import AsyncGenerator, Generator
from concurrent.futures import ThreadPoolExecutor  # the one thread that steps this robot

from gateway.core.tick import Tick


async def in_a_thread(ticks: Generator[Tick]) -> AsyncGenerator[Tick]:
    """Yield what a run yields. It ends when the run has sent its stop actions, also when it is cancelled."""
    with ThreadPoolExecutor(1, "gateway") as thread:  # does what it is asked in order
        try:
            while (tick := await asyncio.wrap_future(thread.submit(next, ticks, None))) is not None:
                yield tick
        finally:
            thread.submit(ticks.close).result()
