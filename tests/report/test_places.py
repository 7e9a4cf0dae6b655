"""The picture of places that may not print well: one mark for each, none where nothing is to be shown."""

import io
from itertools import permutations

import numpy as np
import pytest
from PIL import Image

from fab4d.report.places import FAILED, MARGINAL, Place, places_picture

CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], float)
TETS = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
SMP = np.arange(6) < 3


def pixels(png, colour):
    image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return int(np.sum(np.abs(image - wanted).max(axis=2) < 8))


def drawn(sides, *places):
    return places_picture(CORNERS * np.array(sides), TETS, SMP, places)


def test_without_places_there_is_no_picture():
    assert drawn((10, 10, 10)) is None


@pytest.mark.parametrize("sides", [(10, 10, 10), (300, 4, 4), (4, 4, 200)])
def test_marks_and_words_are_drawn_in_the_colour_of_their_kind(sides):
    where = tuple(0.5 * side for side in sides)
    failed = drawn(sides, Place(where, "walls", True))
    barely = drawn(sides, Place(where, "walls", False))
    assert pixels(failed, FAILED) > 100
    assert pixels(failed, MARGINAL) == pixels(barely, FAILED) == 0
    assert pixels(barely, MARGINAL) > 100
    assert pixels(drawn(sides, Place(where, "walls", True), Place(where, "feet", True)), FAILED) > pixels(
        failed, FAILED
    )


def test_equal_places_give_equal_bytes():
    place = Place((1.0, 2.0, 3.0), "walls", True)
    assert drawn((10, 10, 10), place) == drawn((10, 10, 10), place)
