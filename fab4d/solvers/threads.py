"""Independent computations side by side, on the cores that the linear solver leaves idle."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from threading import local
from typing import TypeVar

from threadpoolctl import threadpool_limits

Result = TypeVar("Result")

# Below so many unknowns a factorisation keeps to one thread: more gain a tenth on an idle machine and lose several
# times that on a busy one, for rslab's wait actively.
THREADED_FROM = 50_000
# So many tries are made at once of which the first that succeeds counts: more would mostly be for nothing.
AHEAD = 2


def usable_cores() -> int:
    """The cores that this process may run on, where the system says so, or else all."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def side_by_side(calls: Sequence[Callable[[], Result]], n_unknowns: int) -> list[Result]:
    """The results of calls that do not depend on each other, in their order.

    One after the other where factorisations of n_unknowns take all cores themselves, and within such a call. What one
    raises is raised once all have ended.
    """
    if len(calls) < 2 or _workers(n_unknowns) < 2:
        return [call() for call in calls]
    return [each.result() for each in _ended(calls)]


def first_found(calls: Sequence[Callable[[], Result | None]], n_unknowns: int) -> tuple[int, Result] | None:
    """The place and the result of the first call, in their order, that has one; None where none has.

    Where `side_by_side` works on several cores, AHEAD calls are made at once, whether the first has a result or not.
    What a call raises that comes after the one with a result is ignored.
    """
    at_once = min(_workers(n_unknowns), AHEAD)
    for first in range(0, len(calls), at_once):
        some = calls[first : first + at_once]
        outcomes = [each.result for each in _ended(some)] if len(some) > 1 else some
        for place, outcome in enumerate(outcomes, first):
            if (result := outcome()) is not None:
                return place, result
    return None


def _workers(n_unknowns: int) -> int:
    return 1 if n_unknowns >= THREADED_FROM or getattr(_here, "works", False) else usable_cores()


def _ended(calls: Sequence[Callable[[], Result]]) -> list[Future[Result]]:
    threads = _threads(usable_cores())
    started = [threads.submit(call) for call in calls]
    wait(started)
    return started


_here = local()


def _works() -> None:
    _here.works = True


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    """Threads that are kept: ends of threads are what memory allocators of libraries fail at.

    BLAS has one of its own from then on: several that wait for each other take twice as long as one.
    """
    threadpool_limits(1, user_api="blas")
    return ThreadPoolExecutor(count, initializer=_works)
