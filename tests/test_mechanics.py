"""Radio, sensing, coverage and hazards against brute force and against other libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.sparse import csgraph
from scipy.spatial import distance as scipy_distance

from hipg_bench.mechanics import coverage, hazards, health, radio, sensing

SEEDS = st.integers(0, 2**32 - 1)


def places(seed: int, points: int, worlds: int = 3) -> np.ndarray:
    """(3, points, worlds) random places."""
    return np.random.default_rng(seed).uniform(-1, 1, (3, points, worlds))


def networks(seed: int, nodes: int, density: float) -> np.ndarray:
    """(M, M, 5) random symmetric adjacency without loops."""
    upper = np.triu(np.random.default_rng(seed).random((5, nodes, nodes)) < density, 1)
    return np.ascontiguousarray((upper | upper.transpose(0, 2, 1)).transpose(1, 2, 0))


@given(SEEDS, st.integers(2, 12), st.floats(0.0, 0.6))
def test_reachable_nodes_are_a_connected_component(seed: int, nodes: int, density: float):
    links = networks(seed, nodes, density)
    for source in (0, nodes - 1):
        reached = radio.reachable(links.transpose(2, 0, 1), source)
        for b in range(5):
            _, label = csgraph.connected_components(links[..., b], directed=False)
            assert (reached[b] == (label == label[source])).all()


@given(SEEDS, st.integers(2, 40), st.floats(0.0, 0.6))
def test_hops_are_shortest_path_lengths(seed: int, nodes: int, density: float):
    links = networks(seed, nodes, density / nodes**0.5)
    count = radio.hops(links, [nodes - 1, 0])
    for b in range(5):
        length = csgraph.shortest_path(links[..., b], unweighted=True, directed=False)[[nodes - 1, 0]]
        assert (count[..., b] == np.where(np.isinf(length), -1, length)).all()


def test_a_chain_of_four_links():
    # 0 - 2 - 3 - 4 - 1, and node 5 alone: four links from 0 to 1, and 5 is not reached
    links = np.zeros((6, 6, 1), bool)
    for a, b in ((0, 2), (2, 3), (3, 4), (4, 1)):
        links[a, b] = links[b, a] = True
    assert radio.hops(links, [0])[0, :, 0].tolist() == [0, 4, 1, 2, 3, -1]
    assert radio.reachable(links.transpose(2, 0, 1), 0).tolist() == [[True] * 5 + [False]]


def test_64_nodes_in_a_row():
    links = np.eye(64, k=1, dtype=bool) | np.eye(64, k=-1, dtype=bool)
    assert radio.hops(links[..., None], [63])[0, :, 0].tolist() == list(range(63, -1, -1))


@given(SEEDS, st.integers(1, 6), st.integers(1, 7))
def test_distances_are_scipys(seed: int, p: int, q: int):
    a, b = places(seed, p), places(seed + 1, q)
    ours, apart = coverage.distances(a, b), coverage.apart(a)
    for w in range(3):
        theirs = scipy_distance.cdist(a[..., w].T, b[..., w].T)
        np.testing.assert_allclose(ours[..., w], theirs, rtol=1e-12, atol=1e-12)
        theirs = scipy_distance.cdist(a[..., w].T, a[..., w].T)
        theirs[np.diag_indices(p)] = np.inf
        np.testing.assert_allclose(apart[..., w], theirs, rtol=1e-12, atol=1e-12)


@given(SEEDS, st.integers(1, 6), st.floats(0.05, 3))
def test_nearest_by_a_plain_loop(seed: int, agents: int, nobody: float):
    rng = np.random.default_rng(seed)
    distance, counts = rng.uniform(0, 2, (agents, 5, 4)), rng.random((agents, 4)) < 0.6
    ours = coverage.nearest(distance, counts, nobody)
    for b in range(4):
        for p in range(5):
            best = nobody
            for i in range(agents):
                if counts[i, b]:
                    best = min(best, distance[i, p, b])
            assert ours[p, b] == best


@pytest.mark.parametrize("cache", [1, 40, coverage._CACHE])
@given(seed=SEEDS, agents=st.integers(1, 6), cap=st.floats(0.05, 3))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nearest_other_by_a_plain_loop(
    seed: int, agents: int, cap: float, cache: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(coverage, "_CACHE", cache)
    rng = np.random.default_rng(seed)
    distance, counts = rng.uniform(0, 2, (agents, 5, 4)), rng.random((agents, agents, 4)) < 0.6
    ours = coverage.nearest_other(distance, counts, cap)
    for i in range(agents):
        for p in range(5):
            for b in range(4):
                known = [distance[j, p, b] for j in range(agents) if counts[i, j, b]]
                assert ours[i, p, b] == np.float32(min([cap, *known]))


@given(SEEDS, st.integers(2, 7), st.floats(0.05, 1.5))
def test_contacts_by_a_plain_loop(seed: int, agents: int, reach: float):
    place, counts = places(seed, agents), np.random.default_rng(seed).random((agents, 3)) < 0.7
    ours = coverage.contacts(coverage.apart(place), counts, reach)
    for b in range(3):
        pairs = 0
        for i in range(agents):
            for j in range(i):
                near = math.dist(place[:, i, b], place[:, j, b]) < reach
                pairs += near and counts[i, b] and counts[j, b]
        assert ours[b] == pairs


def expect(sensed: sensing.Sensed, agent: int, world: int, others: list[int], worlds: int) -> None:
    """The slots hold ``others``, nearest first, as far as there is room, and then the agent itself."""
    slots = len(sensed.seen)
    others = others[:slots]
    empty = slots - len(others)
    assert sensed.seen[:, agent, world].tolist() == [True] * len(others) + [False] * empty
    held = [other * worlds + world for other in others + [agent] * empty]
    assert sensed.place[:, agent, world].tolist() == held


@given(SEEDS, st.integers(2, 31), st.floats(0.1, 2), st.data())
def test_sensing_by_a_plain_loop(seed: int, agents: int, radius: float, data: st.DataObject):
    few, many = data.draw(st.integers(1, agents)), data.draw(st.integers(1, agents))
    place, first = places(seed, agents), np.random.default_rng(seed).random((agents, 3)) < 0.3
    apart = coverage.apart(place)
    all_alike = sensing.nearest_within(apart, radius, many)
    of_first, of_rest = sensing.nearest_of_two_kinds(apart, first, radius, (few, many))
    for b in range(3):
        for i in range(agents):
            near = sorted(
                (math.dist(place[:, i, b], place[:, j, b]), j)
                for j in range(agents)
                if j != i and math.dist(place[:, i, b], place[:, j, b]) <= radius
            )
            expect(all_alike, i, b, [j for _, j in near], 3)
            expect(of_first, i, b, [j for _, j in near if first[j, b]], 3)
            expect(of_rest, i, b, [j for _, j in near if not first[j, b]], 3)


def test_things_at_the_same_distance_go_by_number():
    distance = np.array([3.0, 1.0, 2.0, 1.0, 2.0, 0.0])[None, :, None]
    assert sensing.nearest(distance, 6)[:, 0, 0].tolist() == [5, 1, 3, 2, 4, 0]


@given(SEEDS, st.integers(1, 31), st.integers(1, 31), st.data())
def test_looking_up_by_a_plain_loop(seed: int, agents: int, things: int, data: st.DataObject):
    slots = data.draw(st.integers(1, things))
    rng = np.random.default_rng(seed)
    distance, shared = rng.uniform(0, 40, (agents, things, 3)), rng.normal(size=(2, things, 3))
    own = rng.normal(size=distance.shape)
    nearest = sensing.nearest(distance, slots)
    found, found_own = sensing.look_up(shared, nearest), sensing.look_up_own(own, nearest)
    for b in range(3):
        for i in range(agents):
            order = sorted(range(things), key=lambda m: distance[i, m, b])[:slots]
            assert found[:, :, i, b].tolist() == shared[:, order, b].tolist()
            assert found_own[:, i, b].tolist() == own[i, order, b].tolist()


def test_risk_is_the_published_law():
    # peak 0.5: 0.5 (1 - s^2) at s = d / R = 0, .25, .5, .75, .9, 1, and nothing beyond
    share = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.0, 1.5])
    expected = [0.5, 0.46875, 0.375, 0.21875, 0.095, 0.0, 0.0]
    np.testing.assert_allclose(hazards.risk(share * 0.35, 0.35, 0.5), expected, atol=1e-15)


@given(st.floats(0, 0.99), st.integers(1, 20))
def test_exposure_does_not_depend_on_the_control_rate(probability: float, parts: int):
    whole = health.hazard_rate(np.array([probability]), 1.0)
    in_parts = parts * health.hazard_rate(np.array([probability]), 1.0 / parts)
    np.testing.assert_allclose(in_parts, whole, rtol=1e-12, atol=1e-300)
    # outliving one reference step has chance 1 - p
    assert math.exp(-whole.item()) == pytest.approx(1 - probability, rel=1e-12)
