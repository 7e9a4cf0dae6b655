"""Independent computations side by side."""

import os
import subprocess
import sys
import threading
import time

import pytest

from fab4d.solvers import threads
from fab4d.solvers.threads import THREADED_FROM, first_found, side_by_side


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


def test_calls_within_calls_do_not_wait_for_threads_that_wait_for_them(cores):
    cores(2)

    def outer(name: str) -> list[str]:
        return side_by_side([lambda: name + "1", lambda: name + "2"], 1)

    assert side_by_side([lambda: outer("a"), lambda: outer("b"), lambda: outer("c")], 1) == [
        ["a1", "a2"],
        ["b1", "b2"],
        ["c1", "c2"],
    ]


def test_all_calls_have_ended_when_one_raises(cores):
    cores(2)
    ended = []

    def slow() -> None:
        time.sleep(0.2)
        ended.append(True)

    def fails() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        side_by_side([fails, slow], 1)
    assert ended


def test_systems_are_first_solved_in_threads_that_end():
    """In a new process: the allocator of rslab crashed in the second thread where the first one had loaded it."""
    code = """
import threading, numpy as np
from fab4d.solvers.linear import analyse
from fab4d.solvers.threads import side_by_side
n = 300
indptr, indices = np.r_[np.arange(0, 2 * n, 2), 2 * n - 1], np.column_stack([np.arange(n), np.arange(1, n + 1)]).ravel()
data = np.tile([2.5, -1.0], n)[: 2 * n - 1]
def solve():
    analyse(indptr, indices[: 2 * n - 1]).factor(data).solve_many(np.ones((n, 3)))
for _ in range(20):
    one = threading.Thread(target=solve)
    one.start()
    one.join()
    side_by_side([solve, solve, solve], n)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_blas_keeps_to_one_thread_beside_ours():
    """In a process of its own: the threads of this one are made once."""
    code = """
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits
from fab4d.solvers import threads

def blas():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

threads.usable_cores = lambda: 2
threadpool_limits(2, user_api="blas")
before = blas()
threads.side_by_side([int, int], 1)
print(before, blas())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "{2} {1}", done.stderr


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("place", range(5))
def test_of_tries_the_first_that_succeeds_counts_on_any_number_of_cores(cores, count, place):
    cores(count)
    tries = [lambda k=k: str(k) if k >= place else None for k in range(5)]
    assert first_found(tries, 1) == (place, str(place))


@pytest.mark.parametrize("count", [1, 2])
def test_tries_of_which_none_succeeds_find_nothing(cores, count):
    cores(count)
    assert first_found([lambda: None] * 3, 1) is None
    assert first_found([], 1) is None


def test_the_next_try_is_made_with_the_first_where_a_core_is_free(cores):
    made, both = [], threading.Barrier(2, timeout=10)

    def tried(k: int) -> int:
        made.append(k)
        if max(made) < 2 and not alone:
            both.wait()  # is passed only if the other waits too
        return k

    for alone, count, unknowns in ((False, 2, 1), (True, 1, 1), (True, 2, THREADED_FROM)):
        cores(count)
        made.clear()
        assert first_found([lambda k=k: tried(k) for k in range(4)], unknowns) == (0, 0)
        assert sorted(made) == ([0] if alone else [0, 1])


def test_what_a_try_raises_counts_unless_one_before_it_succeeds(cores):
    cores(2)

    def fails() -> int | None:
        raise ZeroDivisionError

    assert first_found([lambda: 1, fails], 1) == (0, 1)
    with pytest.raises(ZeroDivisionError):
        first_found([lambda: None, fails, lambda: 1], 1)
