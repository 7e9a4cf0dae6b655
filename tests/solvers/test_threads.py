"""Independent computations side by side."""

import os
import threading

import pytest

from fab4d.solvers import threads
from fab4d.solvers.threads import THREADED_FROM, side_by_side


@pytest.fixture
def cores(monkeypatch):
    """Sets the number of cores that this process may run on."""
    return lambda count: monkeypatch.setattr(threads, "usable_cores", lambda: count)


def test_only_the_cores_that_are_given_are_used(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert threads.usable_cores() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert threads.usable_cores() == 1


def test_two_calls_run_at_the_same_time_and_keep_their_order(cores):
    cores(2)
    both = threading.Barrier(2, timeout=10)

    def call(name: str) -> str:
        both.wait()  # is passed only if the other call waits too
        return name

    assert side_by_side([lambda: call("first"), lambda: call("second")], 1) == ["first", "second"]


@pytest.mark.parametrize(("count", "unknowns"), [(1, 1), (2, THREADED_FROM)])
def test_calls_follow_each_other_where_there_is_no_core_for_them(cores, count, unknowns):
    cores(count)
    assert set(side_by_side([threading.get_ident] * 3, unknowns)) == {threading.get_ident()}


def test_what_a_call_raises_is_raised(cores):
    cores(2)

    def fails() -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        side_by_side([lambda: 1, fails], 1)
