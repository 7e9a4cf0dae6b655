"""A mesh for stages that need one, a monitor with a memory, and a way to bent_bar.py and the shapes of `samples/`."""

import sys
from collections.abc import Mapping
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from fab4d.mesh.measures import tet_volumes
from fab4d.stages.monitor import SilentMonitor

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2] / "samples")]


class Memory(SilentMonitor):
    """A monitor that restores what it saved."""

    def __init__(self, saved: Mapping[str, Mapping[str, np.ndarray]] | None = None) -> None:
        self.saved = dict(saved or {})

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        self.saved[name] = {key: np.array(value) for key, value in arrays.items()}

    def restore(self, name: str) -> Mapping[str, np.ndarray] | None:
        return self.saved.get(name)


@pytest.fixture(scope="session")
def memory() -> type[Memory]:
    """The class of monitors with a memory."""
    return Memory


@pytest.fixture(scope="module")
def mesh():
    """A box of 6 x 5 x 4 cells of 5 mm, six tets each."""
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    kuhn = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
    places = np.indices((6, 5, 4)).reshape(3, -1).T[:, None] + corners
    X, number = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    tets = number.reshape(-1, 8)[:, kuhn].reshape(-1, 4)
    negative = tet_volumes(5.0 * X, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return {"X": 5.0 * X, "tets": tets}
