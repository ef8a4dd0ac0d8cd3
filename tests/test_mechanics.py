"""Radio, sensing, coverage and hazards against brute force and against other libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
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


def relative(table: np.ndarray, of: int, to: int, world: int) -> list[float]:
    return (table[:, of, world] - table[:, to, world]).astype(np.float32).tolist()


@given(SEEDS, st.integers(2, 31), st.floats(0.1, 2), st.data())
@settings(deadline=None)  # compiled when first called
def test_sensing_by_a_plain_loop(seed: int, agents: int, radius: float, data: st.DataObject):
    slots, wrecks = data.draw(st.integers(1, agents)), data.draw(st.integers(0, agents))
    rng, place, velocity = np.random.default_rng(seed), places(seed, agents), places(seed + 1, agents)
    health = (rng.random((3, agents)) < 0.7) * rng.uniform(0.1, 1, (3, agents))
    team = (coverage.apart(place), radius, health, velocity, place)
    seen = np.full((3, agents, 1 + 8 * slots + 4 * wrecks), np.nan, np.float32)
    sensing.write_team(0, 2, *team, seen, 1, slots, wrecks)
    assert np.isnan(seen[2]).all(), "not asked for"
    sensing.write_team(2, 3, *team, seen, 1, slots, wrecks)
    assert np.isnan(seen[..., 0]).all(), "of others"
    for b in range(3):
        for i in range(agents):
            order = sorted(
                (math.dist(place[:, i, b], place[:, j, b]), j)
                for j in range(agents)
                if j != i and math.dist(place[:, i, b], place[:, j, b]) <= radius
            )
            near = [j for _, j in order if health[b, j] > 0 or not wrecks][:slots]
            lost = [j for _, j in order if health[b, j] == 0][:wrecks]
            free = slots - len(near)
            expected = [1.0] * len(near) + [0.0] * free
            expected += [float(np.float32(health[b, j])) for j in near] + [0.0] * free
            for table in (place, velocity):
                expected += [x for j in near for x in relative(table, j, i, b)] + [0.0] * 3 * free
            expected += [1.0] * len(lost) + [0.0] * (wrecks - len(lost))
            expected += [x for j in lost for x in relative(place, j, i, b)] + [0.0] * 3 * (wrecks - len(lost))
            assert seen[b, i, 1:].tolist() == expected


@given(SEEDS, st.integers(1, 9), st.integers(1, 9), st.floats(0.1, 2))
@settings(deadline=None)  # compiled when first called
def test_points_by_a_plain_loop(seed: int, agents: int, points: int, radius: float):
    rng, place, point = np.random.default_rng(seed), places(seed, agents), places(seed + 1, points)
    health, revealed = (rng.random((3, agents)) < 0.7) * 1.0, rng.random((points, 3)) < 0.3
    away, apart = coverage.distances(place, point), coverage.apart(place)
    seen = np.full((3, agents, 5 * points), np.nan, np.float32)
    sensing.write_points(0, 3, away, apart, radius, health, place, point, revealed, seen, 0)
    for b in range(3):
        for i in range(agents):
            order = sorted(range(points), key=lambda k: math.dist(place[:, i, b], point[:, k, b]))
            expected = [
                float(np.float32(point[axis, k, b] - place[axis, i, b])) for k in order for axis in range(3)
            ]
            expected += [float(revealed[k, b]) for k in order]
            for k in order:
                known = [
                    away[j, k, b]
                    for j in range(agents)
                    if j != i and health[b, j] > 0 and apart[i, j, b] <= radius
                ]
                expected.append(float(np.float32(min([radius, *known]))))
            assert seen[b, i].tolist() == expected


def test_things_at_the_same_distance_go_by_number():
    order, distance = np.empty(6, np.int64), np.empty(6)
    assert sensing.rank_within(np.array([3.0, 1.0, 2.0, 1.0, 2.0, 0.0]), 2.0, order, distance) == 5
    assert order[:5].tolist() == [5, 1, 3, 2, 4]
    assert distance[:5].tolist() == [0.0, 1.0, 1.0, 2.0, 2.0]


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
