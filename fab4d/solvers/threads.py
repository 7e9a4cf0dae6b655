"""Independent computations side by side, on the cores that the linear solver leaves idle."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from threading import local
from typing import TypeVar

Result = TypeVar("Result")

# Below so many unknowns a factorisation keeps to one thread: more gain a tenth on an idle machine and lose several
# times that on a busy one, for rslab's wait actively.
THREADED_FROM = 50_000


def usable_cores() -> int:
    """The cores that this process may run on, where the system says so, or else all."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def side_by_side(calls: Sequence[Callable[[], Result]], n_unknowns: int) -> list[Result]:
    """The results of calls that do not depend on each other, in their order.

    One after the other where factorisations of n_unknowns take all cores themselves, and within such a call. What one
    raises is raised once all have ended.
    """
    workers = min(usable_cores(), len(calls))
    if workers < 2 or n_unknowns >= THREADED_FROM or getattr(_here, "works", False):
        return [call() for call in calls]
    threads = _threads(usable_cores())
    started = [threads.submit(call) for call in calls]
    wait(started)
    return [each.result() for each in started]


_here = local()


def _works() -> None:
    _here.works = True


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    """Threads that are kept: ends of threads are what memory allocators of libraries fail at."""
    return ThreadPoolExecutor(count, initializer=_works)
