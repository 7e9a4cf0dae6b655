"""Who touches whom."""

import numpy as np

from fab4d.mesh.topology import cells_by_vertex


def test_cells_by_vertex_are_those_that_name_it():
    """Vertices that no cell names, first, last and between, have none."""
    cells = np.random.default_rng(0).choice([1, 2, 3, 5, 6, 7], size=(9, 3))
    start, found = cells_by_vertex(cells, 9)
    for vertex in range(9):
        named = [cell for cell, vertices in enumerate(cells) for v in vertices if v == vertex]
        assert found[start[vertex] : start[vertex + 1]].tolist() == named
    assert len(found) == cells.size
