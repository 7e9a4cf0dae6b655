"""The temperature schedule: heat, load, hold, cool, unload, measure, and how long each bath takes."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from fab4d.materials.cards import MaterialCard
from fab4d.mesh.distance import largest_surface_distance
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import unique_edges

ROOM_TEMPERATURE = 293.0
"""K"""
BATH_MARGIN = 5.0
"""How far a bath is beyond the temperature that the core must reach, K; with none it would take for ever."""
CONDUCTIVITY = 0.20
"""Heat conductivity of unfilled printed polymers, W/(m K): 0.19 to 0.25 in data sheets of TPU and PU."""
SPECIFIC_HEAT = 1500.0
"""Specific heat of thermoplastic polyurethane, J/(kg K): 1400 to 1800 in data sheets."""
FILM_COEFFICIENTS = (("stirred water", 500.0), ("oven or air", 18.0))
"""Heat transfer coefficients, W/(m^2 K): Incropera & DeWitt, Fundamentals of Heat and Mass Transfer, table 1.1."""


@dataclass(frozen=True)
class BathTime:
    """Minutes until the core of the part is through, in one kind of bath."""

    bath: str
    minutes: float


@dataclass(frozen=True)
class Step:
    """One step at the rig: its name, what to do, the bath temperature (K) and the times, where there is a bath."""

    name: str
    text: str
    bath_temperature: float | None = None
    core_temperature: float | None = None
    times: tuple[BathTime, ...] = ()


def thickness(X: FloatArray, tets: IntArray, faces: IntArray) -> float:
    """Diameter of the largest ball found inside the part, mm: the wall that heat must get through.

    X : (n, 3), mm      tets : (m, 4)       faces : (b, 3) boundary
    Balls are tried at the vertices, at the middles of edges and at the centroids of tets.
    """
    edges, _ = unique_edges(tets)
    centers = np.concatenate([X[np.unique(tets)], X[edges].mean(axis=1), X[tets].mean(axis=1)])
    return 2.0 * largest_surface_distance(centers, X, faces)


def conduction_time(wall: float, film: float, density: float, remaining: float) -> float:
    """Seconds until the middle of a plane wall has all but the fraction `remaining` of a step in temperature.

    wall : thickness, mm    film : W/(m^2 K)    density : g/cm^3
    One-term solution: remaining = C exp(-z^2 a t / L^2), L half the wall, z tan z = Bi = film L / k,
    C = 4 sin z / (2 z + sin 2z). Source: Incropera & DeWitt, section 5.5.1. Good from a t / L^2 = 0.2 on; a round or
    square bar is through sooner.
    """
    half = 0.5e-3 * wall
    z = brentq(lambda v: v * np.sin(v) - film * half / CONDUCTIVITY * np.cos(v), 0.0, np.pi / 2)
    C = 4.0 * np.sin(z) / (2.0 * z + np.sin(2.0 * z))
    diffusivity = CONDUCTIVITY / (1e3 * density * SPECIFIC_HEAT)
    return float(max(np.log(C / remaining), 0.0) / z**2 * half**2 / diffusivity)


def bath_times(wall: float, density: float, start: float, core: float, bath: float) -> tuple[BathTime, ...]:
    """Minutes, rounded up to a half, from `start` to `core` (K) in each kind of bath at `bath` (K)."""
    remaining = abs(bath - core) / abs(bath - start)
    seconds = [(name, conduction_time(wall, film, density, remaining)) for name, film in FILM_COEFFICIENTS]
    return tuple(BathTime(name, float(np.ceil(s / 30.0) / 2.0)) for name, s in seconds)


def schedule(card: MaterialCard, wall: float, clamped: bool) -> tuple[Step, ...]:
    """The steps from a cold, printed part to the measured temporary shape, for a part `wall` mm thick."""
    hot = card.transition_temperature + card.transition_half_width
    cold = card.transition_temperature - card.transition_half_width
    density = max(card.smp_density, card.tpe_density)
    hot_bath, cold_bath = hot + BATH_MARGIN, cold - BATH_MARGIN
    heating = bath_times(wall, density, ROOM_TEMPERATURE, hot, hot_bath)
    cooling = bath_times(wall, density, hot_bath, cold, cold_bath)
    place = "Put the part in the clamp" if clamped else "Lay the part down"
    release = "Release the pads, then the clamp." if clamped else "Release the pads."
    return (
        Step("Mount", f"{place}, marked corner as drawn. Attach the pads; pull nothing yet."),
        Step("Heat", "Until the core is soft.", hot_bath, hot, heating),
        Step("Load", "In the bath, move all pads together, in five equal moves, to their hold positions."),
        Step("Hold", "Lock the positions. A hanging weight drifts while the part cools; a locked cable does not."),
        Step("Cool", "Locked, until the core is hard.", cold_bath, cold, cooling),
        Step("Unload", release),
        Step("Measure", "Check the distances. Reheating without load brings the printed shape back."),
    )
