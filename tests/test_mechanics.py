"""Radio, distances, orders and hazards against brute force and against other libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csgraph
from scipy.spatial import distance as scipy_distance

from hipg_bench.mechanics import geometry, hazards, radio

SEEDS = st.integers(0, 2**32 - 1)


def network(seed: int, nodes: int, density: float) -> np.ndarray:
    """(M, M) random symmetric adjacency without loops."""
    upper = np.triu(np.random.default_rng(seed).random((nodes, nodes)) < density, 1)
    return upper | upper.T


def hops_from(links: np.ndarray, source: int) -> list[int]:
    hops, queue = np.full(len(links), 99), np.full(len(links), 99)
    radio.count_hops(links, source, hops, queue)
    return hops.tolist()


@given(SEEDS, st.integers(2, 40), st.floats(0.0, 0.6))
def test_hops_are_shortest_path_lengths(seed: int, nodes: int, density: float):
    links = network(seed, nodes, density / nodes**0.5)
    for source in (nodes - 1, 0):
        length = csgraph.shortest_path(links, unweighted=True, directed=False)[source]
        assert hops_from(links, source) == np.where(np.isinf(length), -1, length).tolist()


@given(SEEDS, st.integers(2, 12), st.floats(0.0, 0.6))
def test_reachable_nodes_are_a_connected_component(seed: int, nodes: int, density: float):
    links = network(seed, nodes, density)
    _, label = csgraph.connected_components(links, directed=False)
    for source in (0, nodes - 1):
        assert ((np.array(hops_from(links, source)) >= 0) == (label == label[source])).all()


def test_a_chain_of_four_links():
    # 0 - 2 - 3 - 4 - 1, and node 5 alone: four links from 0 to 1, and 5 is not reached
    links = np.zeros((6, 6), bool)
    for a, b in ((0, 2), (2, 3), (3, 4), (4, 1)):
        links[a, b] = links[b, a] = True
    assert hops_from(links, 0) == [0, 4, 1, 2, 3, -1]


def test_64_nodes_in_a_row():
    links = np.eye(64, k=1, dtype=bool) | np.eye(64, k=-1, dtype=bool)
    assert hops_from(links, 63) == list(range(63, -1, -1))


@given(SEEDS)
def test_distances_are_scipys(seed: int):
    a, b = np.random.default_rng(seed).uniform(-1, 1, (2, 3))
    assert geometry.distance3(a, b) == pytest.approx(scipy_distance.euclidean(a, b), rel=1e-12, abs=1e-12)


@given(SEEDS, st.integers(1, 128))
def test_means_are_numpys_to_the_bit(seed: int, size: int):
    part = np.random.default_rng(seed).normal(size=size)
    assert geometry.mean(part) == np.mean(part)
    assert geometry.mean(part) == pytest.approx(math.fsum(part) / size, rel=1e-12, abs=1e-14)


@given(SEEDS, st.integers(1, 31), st.floats(0, 2))
def test_ranks_by_sorting(seed: int, size: int, radius: float):
    # rounded, so that many are as far away as others
    away = np.random.default_rng(seed).uniform(0, 2, size).round(1)
    order, distance = np.full(size, -1), np.full(size, np.nan)
    expected = sorted((d, k) for k, d in enumerate(away.tolist()) if d <= radius)
    assert geometry.rank_within(away, radius, order, distance) == len(expected)
    found = zip(distance[: len(expected)].tolist(), order[: len(expected)].tolist(), strict=True)
    assert list(found) == expected


def test_things_at_the_same_distance_go_by_number():
    order, distance = np.empty(6, np.int64), np.empty(6)
    assert geometry.rank_within(np.array([3.0, 1.0, 2.0, 1.0, 2.0, 0.0]), 2.0, order, distance) == 5
    assert order[:5].tolist() == [5, 1, 3, 2, 4]
    assert distance[:5].tolist() == [0.0, 1.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("share", "chance"),
    # peak 0.5: 0.5 (1 - s^2) at s = d / R, and nothing beyond
    [(0.0, 0.5), (0.25, 0.46875), (0.5, 0.375), (0.75, 0.21875), (0.9, 0.095), (1.0, 0.0), (1.5, 0.0)],
)
def test_risk_is_the_published_law(share: float, chance: float):
    assert hazards.risk(share * 0.35, 0.35, 0.5) == pytest.approx(chance, abs=1e-15)


@given(st.floats(0, 0.99), st.integers(1, 20))
def test_hazard_does_not_depend_on_the_control_rate(probability: float, parts: int):
    whole = hazards.hazard_rate(probability, 1.0)
    in_parts = parts * hazards.hazard_rate(probability, 1.0 / parts)
    assert in_parts == pytest.approx(whole, rel=1e-12, abs=1e-300)
    # outliving one reference step has chance 1 - p
    assert math.exp(-whole) == pytest.approx(1 - probability, rel=1e-12)
