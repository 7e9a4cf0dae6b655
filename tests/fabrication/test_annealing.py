"""Annealed labels: the least energy of all that pinch nothing, found again by trying them all."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pinches import pinched_by_hand

from fab4d.fabrication import annealing
from fab4d.fabrication._repair_kernels import all_defects
from fab4d.fabrication.annealing import annealer
from fab4d.fabrication.features import tet_neighbours
from fab4d.fabrication.wellcomposed import link_tables, well_composed
from fab4d.mesh.measures import tet_volumes


@dataclass(frozen=True, eq=False)
class Energy:
    tets: np.ndarray
    error: np.ndarray
    changes: np.ndarray
    beyond: np.ndarray
    limit_changes: np.ndarray
    price: float
    defect_price: float = 0.0
    doubt: np.ndarray | float = 0.0

    @property
    def doubts(self) -> np.ndarray:
        return self.doubt + np.zeros(len(self.tets))

    def of(self, before: np.ndarray, labels: np.ndarray) -> float:
        flipped = (labels != before)[self.tets]
        error = self.error + self.changes[flipped].sum(axis=0)
        beyond = self.beyond + self.limit_changes[flipped].sum(axis=0)
        return float(error @ error + (np.maximum(beyond, 0) ** 2).sum() + ((self.price + self.doubts) * flipped).sum())


def energy_by_chance(tets: np.ndarray, seed: int, measures: int = 5, price: float = 1e-3) -> Energy:
    """Two limits, of which one is kept to begin with; some flips take doubts away."""
    random = np.random.default_rng(seed)
    changes, limit_changes = 0.05 * random.normal(size=(len(tets), measures)), 0.03 * random.normal(size=(len(tets), 2))
    doubts = 1e-3 * random.normal(size=len(tets))
    limits = np.array([0.05, -0.04])
    return Energy(tets, random.normal(size=measures), changes, limits, limit_changes, price, doubt=doubts)


def case(meshes, seed, n_points=20):
    X, tets = meshes["irregular"](n_points, seed)
    volumes = tet_volumes(X, tets)
    smp = well_composed(tets, np.random.default_rng(seed).random(len(tets)) < 0.5, volumes)
    return tets, volumes / volumes.sum(), smp


def interface(tets, smp):
    neighbours = tet_neighbours(tets)
    return np.flatnonzero(((neighbours >= 0) & (smp[neighbours] != smp[:, None])).any(axis=1))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), n_points=st.integers(5, 40))
def test_nothing_is_pinched_and_the_energy_falls(meshes, seed, n_points):
    tets, volumes, smp = case(meshes, seed, n_points)
    energy = energy_by_chance(np.arange(len(tets)), seed)
    labels = annealer(tets, volumes)(smp, energy, 1.0, 50, seed)
    assert pinched_by_hand(tets, labels) == []
    assert energy.of(smp, labels) <= energy.of(smp, smp)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), n_points=st.integers(5, 40))
@example(seed=1715, n_points=19)  # 8 of 26 are left
def test_most_of_what_is_pinched_is_mended_where_that_is_worth_much(meshes, seed, n_points):
    """And less where it is not; never is more pinched than before."""
    X, tets = meshes["irregular"](n_points, seed)
    smp, volumes = np.random.default_rng(seed).random(len(tets)) < 0.5, tet_volumes(X, tets)
    energy, annealed = energy_by_chance(np.arange(len(tets)), seed), annealer(tets, volumes / volumes.sum())
    dear = annealed(smp, replace(energy, defect_price=10.0), 1.0, 300, seed)
    left = [len(pinched_by_hand(tets, labels)) for labels in (smp, annealed(smp, energy, 1.0, 300, seed), dear)]
    assert left[0] >= left[1]
    assert left[2] <= 0.5 * left[0]


def test_a_flip_is_made_that_costs_less_than_the_defects_it_mends_are_worth(meshes):
    mended = 0
    for seed in range(30):
        tets, volumes, smp = case(meshes, seed)
        tet = np.random.default_rng(seed).integers(0, len(tets), 1)
        spoilt = smp.copy()
        spoilt[tet] ^= True
        links, scratch = link_tables(tets)
        nowhere = np.zeros(len(links.n_nodes), bool)
        defects, none = (int(all_defects(nowhere, labels, links, scratch).sum()) for labels in (spoilt, smp))
        if defects == 0 or tet[0] not in interface(tets, spoilt):
            continue
        assert none == 0
        nothing, cost = np.zeros(0), 0.7**2 + 0.1
        energy = Energy(tet, np.array([1e-6]), np.array([[0.7]]), nothing, np.zeros((1, 0)), 0.1)
        for factor, labels in ((0.95, spoilt), (1.05, smp)):
            worth = replace(energy, defect_price=factor * cost / defects)
            np.testing.assert_array_equal(annealer(tets, volumes)(spoilt, worth, 1.0, 500, 0), labels)
        mended += 1
    assert mended > 3


def reachable(tets, smp, candidates):
    """All labels that flips of candidates at the interface lead to, none of them pinched but on the way."""
    reached, waiting = {smp.tobytes(): smp}, [smp]
    while waiting:
        labels = waiting.pop()
        at = set(interface(tets, labels).tolist())
        for tet in candidates:
            after = labels.copy()
            after[tet] ^= True
            if tet in at and after.tobytes() not in reached:
                reached[after.tobytes()] = after
                waiting.append(after)
    return [labels for labels in reached.values() if pinched_by_hand(tets, labels) == []]


def near_each_other(meshes, seed, count):
    """A case with an even interface, and `count` tets there with many common corners."""
    X, tets = meshes["irregular"](100, seed)
    volumes, left = tet_volumes(X, tets), X[tets].mean(axis=1)[:, 0] < np.median(X[:, 0])
    smp = well_composed(tets, left, volumes)
    common = np.isin(tets, tets[interface(tets, smp)[0]]).sum(axis=1)
    return tets, volumes / volumes.sum(), smp, np.sort(np.argsort(-common, kind="stable")[:count])


def test_the_least_of_all_allowed_energies_is_found(meshes):
    """By going through them all."""
    found = 0
    for seed in range(12):
        tets, volumes, smp, candidates = near_each_other(meshes, seed, 8)
        energy = energy_by_chance(candidates, seed)
        least = min(energy.of(smp, labels) for labels in reachable(tets, smp, candidates))
        assert energy.of(smp, annealer(tets, volumes)(smp, energy, 1.0, 5000, 0)) == pytest.approx(least)
        found += least < energy.of(smp, smp)
    assert found > 3


def test_past_pinched_labels_there_is_less_energy(meshes, monkeypatch):
    X, tets = meshes["box"]((4, 4, 4))
    volumes, smp = tet_volumes(X, tets), X[tets].mean(axis=1)[:, 0] < 2.0
    annealed = annealer(tets, volumes / volumes.sum())

    def found() -> list[float]:
        energies = [energy_by_chance(np.arange(len(tets)), seed, measures=20) for seed in range(8)]
        return [energy.of(smp, annealed(smp, energy, 1.0, 300, 0)) for energy in energies]

    past = found()
    monkeypatch.setattr(annealing, "PINCHED", 1e6)
    assert np.mean(past) < 0.95 * np.mean(found())


def test_there_is_an_end_to_the_steps(meshes, monkeypatch):
    tets, volumes, smp = case(meshes, 3)
    monkeypatch.setattr(annealing, "MOST_STEPS", 0)
    energy = energy_by_chance(np.arange(len(tets)), 3)
    np.testing.assert_array_equal(annealer(tets, volumes)(smp, energy, 1.0, 200, 1), smp)


def test_the_least_energy_of_all_first_temperatures_is_taken(meshes, monkeypatch):
    """None does worse than the one that is tried first alone, and some do better."""
    tets, volumes, smp = case(meshes, 5)
    energy = energy_by_chance(np.arange(len(tets)), 5, measures=60)
    annealed, gains = annealer(tets, volumes), []
    for first in annealing.HOT:
        others = tuple(hot for hot in annealing.HOT if hot != first)
        found = []
        for temperatures in ((first,), (first, *others)):
            monkeypatch.setattr(annealing, "HOT", temperatures)
            found.append(energy.of(smp, annealed(smp, energy, 1.0, 2, 1)))
        monkeypatch.undo()
        gains.append(found[0] - found[1])
    assert min(gains) >= -1e-12
    assert max(gains) > 1e-6


def test_annealings_side_by_side_find_what_one_after_the_other_finds(meshes, monkeypatch):
    tets, volumes, smp = case(meshes, 5, 100)
    energy = energy_by_chance(np.arange(len(tets)), 5, measures=60)
    annealed = annealer(tets, volumes)
    together = annealed(smp, energy, 1.0, 400, 1)
    monkeypatch.setattr(annealing, "side_by_side", lambda calls, _: [call() for call in calls])
    np.testing.assert_array_equal(annealed(smp, energy, 1.0, 400, 1), together)
    assert (together != smp).any()


def test_a_seed_gives_the_same_labels_again(meshes):
    tets, volumes, smp = case(meshes, 5)
    energy = energy_by_chance(np.arange(len(tets)), 5, measures=60)
    annealed = annealer(tets, volumes)
    before = smp.copy()
    first, again, other = (annealed(smp, energy, 1.0, 1, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(smp, before)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("room", [0.0, 0.02, 1.0])
def test_volume_that_may_become_smp_is_not_exceeded(meshes, room):
    """Where all SMP that there is would lower the error."""
    tets, volumes, smp = case(meshes, 7)
    nothing, changes = np.zeros(0), np.where(smp, 1e-3, -1e-3)[:, None]
    wanted = Energy(np.arange(len(tets)), np.ones(1), changes, nothing, np.zeros((len(tets), 0)), 0.0)
    labels = annealer(tets, volumes)(smp, wanted, room, 500, 0)
    grown = volumes @ labels - volumes @ smp
    assert grown <= room + 1e-12
    assert grown >= min(0.9 * room, 0.1) - 0.01


def test_limits_count_until_they_are_kept(meshes):
    """Some twenty flips bring a limit down to what it should be, and more gain nothing."""
    tets, volumes, smp = case(meshes, 7)
    lowers = np.full((len(tets), 1), -0.05)
    energy = Energy(np.arange(len(tets)), np.zeros(1), np.zeros((len(tets), 1)), np.ones(1), lowers, 1e-6)
    labels = annealer(tets, volumes)(smp, energy, 1.0, 500, 0)
    assert 18 <= (labels != smp).sum() <= 22


def test_without_an_error_prices_alone_count(meshes):
    tets, volumes, smp = case(meshes, 7)
    energy = replace(energy_by_chance(np.arange(len(tets)), 7), error=np.zeros(5), beyond=np.array([-1.0, -1.0]))
    energy = replace(energy, doubt=0.0)
    np.testing.assert_array_equal(annealer(tets, volumes)(smp, energy, 1.0, 200, 0), smp)


def test_nothing_is_flipped_that_costs_more_than_it_brings(meshes):
    tets, volumes, smp = case(meshes, 7)
    energy = energy_by_chance(np.arange(len(tets)), 7, price=1e3)
    np.testing.assert_array_equal(annealer(tets, volumes)(smp, energy, 1.0, 200, 0), smp)
    energy = replace(energy, price=0.0, doubt=1e3)
    np.testing.assert_array_equal(annealer(tets, volumes)(smp, energy, 1.0, 200, 0), smp)
