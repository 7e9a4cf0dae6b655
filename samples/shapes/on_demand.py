"""The larger and harder scenes, each meshed with boxes and irregularly. Lengths are mm."""

from collections.abc import Callable
from functools import partial

from fab4d.mesh.tetmesh import FloatArray, IntArray
from shapes import flower as blossom
from shapes import hand as fingers
from shapes import human as figure
from shapes import key as teeth
from shapes import tower as lattice
from shapes.boxes import Body, box, filled
from shapes.implicit import capsule, slab
from shapes.plates import outline_triangles, thickened
from shapes.scene import Sample
from shapes.stuffing import stuffed
from shapes.warps import Turn, bump, domed, ramp, rod, warped

Mesh = tuple[FloatArray, IntArray]


def _human(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    title = "A figure with four limbs posed differently."
    return Sample(title, X, figure.posed(X), tets, figure.CLAMP, 16, 5e-3)


def _hand(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    return Sample("A hand with five fingers closing.", X, fingers.closed(X), tets, fingers.CLAMP, 15, 5e-3)


def _flower(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    return Sample("A flower of five petals closing.", X, blossom.closed(X), tets, blossom.CLAMP, 15, 5e-3)


def _key(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    return Sample("A key whose teeth change.", X, teeth.teeth_bent(X), tets, teeth.CLAMP, 12, 1.7e-3)


ARM_LENGTH, ARM_WIDTH = 168.0, 14.0


def _arm(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    mid = ARM_WIDTH / 2
    line = rod((12, mid, mid), (ARM_LENGTH, mid, mid), (0, 0, 1))
    X_temp = warped(X, line, (Turn((0, 0, 1), 250, bump(0, line.length, 0.2)),))
    return Sample("An arm curled by 250 degrees.", X, X_temp, tets, ((-1, -1, -1), (11.7, 15, 15)), 6, 5e-3)


def _plate(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    X_temp = domed(X, 16.0, 80.0, 2.0, 55)
    return Sample("A plate that domes.", X, X_temp, tets, ((-11, -11, -1), (11, 11, 5)), 12, 5e-3)


def _tower(mesh: Callable[[], Mesh]) -> Sample:
    X, tets = mesh()
    line = rod((0, 0, 12), (0, 0, 200), (1, 0, 0))
    profile = lambda s: ramp(s, 0, 30) * (1.0 + s / 60.0)  # noqa: E731
    X_temp = warped(X, line, (Turn((0, 0, 1), 70, profile),))
    return Sample(
        "A tower of round struts bent by 70 degrees.", X, X_temp, tets, ((-41, -41, -1), (41, 41, 10)), 8, 5e-3
    )


def _plate_of(outline: Body, low: tuple[float, float], high: tuple[float, float], h: float, thickness: float) -> Mesh:
    return thickened(*outline_triangles(outline, low, high, h), thickness, 2)


def _cells_of(outline: Body, low: tuple[float, float], high: tuple[float, float], h: float, thickness: float) -> Mesh:
    return filled(slab(outline, thickness), (*low, 0.0), (*high, thickness), (h, h, thickness / 2))


_ARM_BODY = capsule((7, 7, 7), (161, 7, 7), 7.0, 6.0)
_ROUND_PLATE = capsule((-1, 0), (1, 0), 55.0)
_FLOWER = (blossom.outline, blossom.LOW, blossom.HIGH)
_KEY = (teeth.outline, teeth.LOW, teeth.HIGH)

ON_DEMAND: dict[str, Callable[[], Sample]] = {
    "human": partial(_human, partial(filled, figure.body, figure.LOW, figure.HIGH, 5.5)),
    "human-irregular": partial(_human, partial(stuffed, figure.body, figure.LOW, figure.HIGH, 8.0)),
    "arm": partial(_arm, partial(box, (ARM_LENGTH, ARM_WIDTH, ARM_WIDTH), (42, 3, 3), "five")),
    "arm-irregular": partial(_arm, partial(stuffed, _ARM_BODY, (0, 0, 0), (168, 14, 14), 5.8)),
    "hand": partial(_hand, partial(filled, fingers.body, fingers.LOW, fingers.HIGH, (5.0, 5.0, 4.5))),
    "hand-irregular": partial(_hand, partial(stuffed, fingers.body, fingers.LOW, fingers.HIGH, 7.15)),
    "flower": partial(_flower, partial(_cells_of, *_FLOWER, 3.4, blossom.THICKNESS)),
    "flower-irregular": partial(_flower, partial(_plate_of, *_FLOWER, 4.1, blossom.THICKNESS)),
    "key": partial(_key, partial(_cells_of, *_KEY, 3.0, teeth.THICKNESS)),
    "key-irregular": partial(_key, partial(_plate_of, *_KEY, 3.4, teeth.THICKNESS)),
    "plate": partial(_plate, partial(_cells_of, capsule((0, 0), (1, 0), 1e3), (-50, -50), (50, 50), 4.0, 4.0)),
    "plate-irregular": partial(_plate, partial(_plate_of, _ROUND_PLATE, (-56, -55), (56, 55), 4.0, 4.0)),
    "tower-irregular": partial(_tower, partial(stuffed, lattice.round_struts(), (-42, -42, 0), (42, 42, 202), 6.4)),
}
