"""The state of a search that is saved and read back."""

from dataclasses import fields, replace

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar

from fab4d.design.reduced import Phase, Search, at_rest
from fab4d.errors import ArtifactError
from fab4d.stages._design import problem_of
from fab4d.stages._search import search_arrays, search_from


@pytest.fixture
def start() -> Search:
    return at_rest(problem_of(bent_bar((5, 2, 2), 30.0), PROFILE["materials"], "linear"))


def test_every_number_of_a_state_comes_back(start: Search) -> None:
    plain = {f.name: getattr(start, f.name) for f in fields(start) if f.name not in ("equilibria", "design", "phase")}
    other = {name: not value if isinstance(value, bool) else type(value)(7) for name, value in plain.items()}
    at = replace(start, phase=Phase.ROUND, **other)
    back = search_from(at.equilibria.problem, search_arrays(at))
    assert {name: getattr(back, name) for name in plain} == other
    assert {type(getattr(back, name)) for name in plain} == {bool, int, float}
    assert back.phase is Phase.ROUND
    np.testing.assert_array_equal(back.design.final.y, at.design.final.y)


def test_shapes_that_are_in_no_equilibrium_are_refused(start: Search) -> None:
    saved = search_arrays(start)
    turned_over = saved | {"x": -saved["x"]}
    with pytest.raises(ArtifactError, match="--force"):
        search_from(start.equilibria.problem, turned_over)
