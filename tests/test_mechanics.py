"""Radio, sensing, coverage and hazards against brute force and against other libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csgraph
from scipy.spatial import distance as scipy_distance

from hipg_bench.mechanics import coverage, hazards, health, radio, sensing

SEEDS = st.integers(0, 2**32 - 1)


def places(seed: int, batch: int, points: int, dims: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (batch, points, dims))


def networks(seed: int, batch: int, nodes: int, density: float) -> np.ndarray:
    """(B, M, M) random symmetric adjacency without loops."""
    upper = np.triu(np.random.default_rng(seed).random((batch, nodes, nodes)) < density, 1)
    return upper | upper.transpose(0, 2, 1)


@given(SEEDS, st.integers(2, 12), st.floats(0.0, 0.6))
def test_reachable_nodes_are_a_connected_component(seed: int, nodes: int, density: float):
    links = networks(seed, 5, nodes, density)
    for source in (0, nodes - 1):
        reached = radio.reachable(links, source)
        for b in range(5):
            _, label = csgraph.connected_components(links[b], directed=False)
            assert (reached[b] == (label == label[source])).all()


@given(SEEDS, st.integers(2, 12), st.floats(0.0, 0.6))
def test_hops_are_shortest_path_lengths(seed: int, nodes: int, density: float):
    links = networks(seed, 5, nodes, density)
    count = radio.hops(links, 0, nodes - 1)
    for b in range(5):
        length = csgraph.shortest_path(links[b], unweighted=True, directed=False)[0, nodes - 1]
        assert count[b] == (0 if math.isinf(length) else length)


def test_a_chain_of_four_links():
    # 0 - 2 - 3 - 4 - 1, and node 5 alone: four links from 0 to 1, and 5 is not reached
    links = np.zeros((1, 6, 6), bool)
    for a, b in ((0, 2), (2, 3), (3, 4), (4, 1)):
        links[0, a, b] = links[0, b, a] = True
    assert radio.hops(links, 0, 1).tolist() == [4]
    assert radio.reachable(links, 0).tolist() == [[True] * 5 + [False]]


@given(SEEDS, st.integers(1, 6), st.integers(1, 7))
def test_distances_are_scipys(seed: int, p: int, q: int):
    a, b = places(seed, 3, p), places(seed + 1, 3, q)
    ours = coverage.distances(a, b)
    for world in range(3):
        theirs = scipy_distance.cdist(a[world], b[world])
        np.testing.assert_allclose(ours[world], theirs, rtol=1e-12, atol=1e-12)


@given(SEEDS, st.integers(1, 6), st.floats(0.05, 3))
def test_nearest_by_a_plain_loop(seed: int, agents: int, nobody: float):
    rng = np.random.default_rng(seed)
    distance, counts = rng.uniform(0, 2, (4, 5, agents)), rng.random((4, agents)) < 0.6
    ours = coverage.nearest(distance, counts, nobody)
    for b in range(4):
        for p in range(5):
            best = nobody
            for i in range(agents):
                if counts[b, i]:
                    best = min(best, distance[b, p, i])
            assert ours[b, p] == best


@given(SEEDS, st.integers(2, 7), st.floats(0.05, 1.5))
def test_contacts_by_a_plain_loop(seed: int, agents: int, reach: float):
    rng = np.random.default_rng(seed)
    place, counts = places(seed, 3, agents), rng.random((3, agents)) < 0.7
    ours = coverage.contacts(coverage.distances(place, place), counts, reach)
    for b in range(3):
        for i in range(agents):
            for j in range(agents):
                near = math.dist(place[b, i], place[b, j]) < reach
                assert ours[b, i, j] == (i != j and near and counts[b, i] and counts[b, j])


@given(SEEDS, st.integers(2, 8), st.floats(0.1, 2), st.data())
def test_sensing_by_a_plain_loop(seed: int, agents: int, radius: float, data: st.DataObject):
    slots = data.draw(st.integers(1, agents))
    rng = np.random.default_rng(seed)
    place = places(seed, 3, agents)
    visible = (rng.random((3, agents, agents)) < 0.7) & ~np.eye(agents, dtype=bool)
    sensed = sensing.nearest_within(coverage.distances(place, place), visible, radius, slots)
    found = sensing.gather(place, sensed)
    for b in range(3):
        for i in range(agents):
            seen = sorted(
                (math.dist(place[b, i], place[b, j]), j)
                for j in range(agents)
                if visible[b, i, j] and math.dist(place[b, i], place[b, j]) <= radius
            )[:slots]
            assert sensed.seen[b, i].tolist() == [True] * len(seen) + [False] * (slots - len(seen))
            assert sensed.which[b, i, : len(seen)].tolist() == [j for _, j in seen]
            np.testing.assert_allclose(sensed.distance[b, i, : len(seen)], [d for d, _ in seen], rtol=1e-12)
            assert np.isinf(sensed.distance[b, i, len(seen) :]).all()
            assert (found[b, i, : len(seen)] == place[b, [j for _, j in seen]]).all()
            assert (found[b, i, len(seen) :] == 0).all()


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
