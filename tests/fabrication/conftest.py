"""Meshes with labels: boxes of six tets a cell, irregular ones, and parts that touch themselves.

Lets the tests import pinches.py beside this file, which is no package.
"""

import sys
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay

from fab4d.mesh.grid import snapped
from fab4d.mesh.measures import tet_volumes

sys.path.insert(0, str(Path(__file__).parent))

CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
KUHN = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])


def oriented(X, tets):
    tets = np.array(tets)
    negative = tet_volumes(X, tets) < 0
    tets[negative, 2], tets[negative, 3] = tets[negative, 3].copy(), tets[negative, 2].copy()
    return tets


def cell_mesh(cells, size=1.0):
    """Cubes at the cell numbers `cells` (c, 3), each of six tets."""
    places = (np.asarray(cells)[:, None] + CORNERS).reshape(-1, 3)
    X, number = np.unique(places, axis=0, return_inverse=True)
    X = size * X.astype(float)
    return X, oriented(X, number.reshape(-1, 8)[:, KUHN].reshape(-1, 4))


def box_mesh(shape, size=1.0):
    return cell_mesh(np.indices(shape).reshape(3, -1).T, size)


def irregular_mesh(n_points, seed):
    """Delaunay tets of random points in a box with its corners, at coordinates that files keep as they are."""
    rng = np.random.default_rng(seed)
    X = snapped(10 * np.concatenate([CORNERS, rng.random((n_points, 3))]))
    return X, oriented(X, Delaunay(X).simplices.astype(np.int64))


def blob_labels(X, tets):
    centres = X[tets].mean(axis=1)
    middle = 0.5 * (X.min(axis=0) + X.max(axis=0))
    return np.linalg.norm((centres - middle) / np.ptp(X, axis=0), axis=1) < 0.35


def ring_touching_itself():
    """A chain of cubes whose ends touch in the single vertex (2, 1, 2)."""
    return cell_mesh([(1, 0, 1), (1, 0, 0), (2, 0, 0), (3, 0, 0), (3, 0, 1), (3, 0, 2), (3, 1, 2), (2, 1, 2)])


def meeting_hollows():
    """A cube with two hollows, open below and above, that touch in the single vertex (2, 2, 2)."""
    hollows = {(1, 1, 1), (2, 2, 2), (1, 1, 0), (2, 2, 3)}
    return cell_mesh([cell for cell in np.ndindex(4, 4, 4) if cell not in hollows])


@pytest.fixture(scope="session")
def meshes() -> dict[str, Callable]:
    return {
        "box": box_mesh,
        "cells": cell_mesh,
        "irregular": irregular_mesh,
        "blob": blob_labels,
        "ring": ring_touching_itself,
        "hollows": meeting_hollows,
    }
