"""The paper suite against the authors' laws and the numbers measured on their code.

Expected values are worked out here with plain loops and `math`, from the laws in docs/tasks/paper_suite.md;
reference returns are those that the authors' environments gave over 200 episodes.
"""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import hipg_bench
from hipg_bench.mechanics import plane

DT = 0.1


def arrange(env, position, *, velocity=0.0, dead=(), marker=None, **fields):
    """Put all worlds of a fresh episode into a given state and look at it."""
    env.reset()
    agents = (env.num_envs, env.num_agents, 2)
    health, point = env.get_field("health"), env.get_field("point")
    health[:, list(dead)] = 0.0
    if marker is not None:
        point[..., :2] = marker
    return env.arrange(
        position=np.asarray(position, float).reshape(-1, *agents[1:]),
        velocity=np.asarray(velocity, float).reshape(-1, *agents[1:]) if np.ndim(velocity) else velocity,
        health=health, point=point, **fields,
    )  # fmt: skip


def flat(env, name):
    """What worlds hold under a name, (B, numbers)."""
    return env.get_field(name).reshape(env.num_envs, -1)


def link_range(env):
    """How far a team hears, m."""
    return env.definition.family.link_range(env.spec, env.definition.params)


def still(env):
    return np.zeros((env.num_envs, env.num_agents, 2))


def seen(env, step, name, *, agent=0, world=0):
    return env.layout.observation.view(step.observation, name)[world, agent]


# ------------------------------------------------------------------------------------------ physics


def test_one_agent_follows_the_authors_recursion():
    env = hipg_bench.make("paper_nav-4", num_envs=3, threads=1)
    # 100 m apart: no contacts
    start = np.stack([np.full((3, 4), 0.0), np.broadcast_to(100.0 * np.arange(4), (3, 4))], axis=-1)
    arrange(env, start)
    force = np.random.default_rng(0).normal(0, 3, (50, 3, 4, 2))
    x, v = start.copy(), np.zeros((3, 4, 2))
    for t in range(49):
        env.step(force[t])
        v = 0.75 * v + DT * force[t]
        x = x + DT * v
        assert np.abs(flat(env, "velocity").reshape(3, 4, 2) - v).max() < 1e-12
        assert np.abs(flat(env, "position").reshape(3, 4, 2) - x).max() < 1e-12


def test_unit_force_gives_the_speeds_and_distances_of_the_authors_code():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1, horizon=60)
    arrange(env, [[[0, 0], [0, 9], [0, 18], [0, 27]]])
    speed, distance = {}, {}
    for t in range(1, 51):
        env.step(np.broadcast_to([1.0, 0.0], (1, 4, 2)))
        speed[t], distance[t] = flat(env, "velocity")[0, 0], flat(env, "position")[0, 0]
    assert [round(speed[t], 3) for t in (1, 2, 5, 10, 20)] == [0.1, 0.175, 0.305, 0.377, 0.399]
    assert [round(distance[t], 3) for t in (10, 25, 50)] == [0.287, 0.880, 1.880]
    # 0.1 F / (1 - 0.75) = 0.4 F
    assert speed[50] == pytest.approx(0.4, abs=1e-6)


def test_actions_are_forces_in_newtons_and_not_clipped():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1)
    arrange(env, [[[0, 9 * i] for i in range(10)]])
    env.step(np.broadcast_to([-7.5, 0.0], (1, 10, 2)))
    assert flat(env, "velocity")[0, 0] == pytest.approx(-0.75, abs=1e-12)


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_comm-10"])
@pytest.mark.parametrize("depth", [0.5, 0.02, 1e-3, 0.0, -1e-3, -5e-3, -0.5])
def test_overlapping_agents_push_each_other_apart(task, depth):
    env = hipg_bench.make(task, num_envs=1, threads=1)
    # the authors' radii: 0.15 sqrt(3 / n), and 0.01
    radius = 0.15 * math.sqrt(3 / 4) if task == "paper_nav-4" else 0.01
    distance = 2 * radius * (1 - depth)
    angle = 0.7
    away = np.array([math.cos(angle), math.sin(angle)])
    place = np.array([[0.0, 50.0 * i] for i in range(env.num_agents)])
    place[1] = distance * away
    arrange(env, place[None], hazard_threshold=np.inf)
    env.step(still(env))
    z = (2 * radius - distance) / 1e-3
    softplus = z + math.log1p(math.exp(-z)) if z > 0 else math.log1p(math.exp(z))
    force = 100.0 * 1e-3 * softplus
    velocity = flat(env, "velocity").reshape(-1, 2)
    np.testing.assert_allclose(velocity[1], DT * force * away, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(velocity[0], -DT * force * away, rtol=1e-12, atol=1e-12)
    assert not velocity[2:].any()


def test_an_agent_between_two_others_feels_both():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1)
    arrange(env, [[[0, 0], [0.2, 0], [-0.1, 0.1], [50, 0]]])
    env.step(still(env))
    reach = 2 * 0.15 * math.sqrt(3 / 4)
    # deep inside, softplus(z) = z: 100 N per m of overlap
    from_right, from_left = 100 * (reach - 0.2), 100 * (reach - math.sqrt(0.02))
    expected = [-from_right + from_left / math.sqrt(2), -from_left / math.sqrt(2)]
    np.testing.assert_allclose(flat(env, "velocity")[0, :2], DT * np.array(expected), rtol=1e-9)


# ------------------------------------------------------------------------------------------ the dead


def test_the_dead_stand_still_at_once_and_keep_their_stored_velocity():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1, collision_risk=0.0)
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    toughness = np.full((1, 10), np.inf)
    toughness[0, 0] = 1e-9
    # the hazard is where agent 0 is after its first step
    v = 0.75 * 0.8 + DT * 1.0
    arrange(
        env, place[None], velocity=np.tile([0.8, 0.0], 10)[None], hazard_threshold=toughness,
        marker=[[-1, -9], [1, -9], [DT * v, 0.0]],
    )  # fmt: skip
    push = np.broadcast_to([1.0, 0.0], (1, 10, 2))
    step = env.step(push)
    assert step.info["health"][0].tolist() == [0.0] + [1.0] * 9
    frozen = flat(env, "position")[0, :2].copy()
    for _ in range(5):
        step = env.step(push)
        assert (flat(env, "position")[0, :2] == frozen).all()
        assert not flat(env, "velocity")[0, :2].any()
        stored = env.layout.state.view(step.info["state"], "velocity")[0]
        np.testing.assert_allclose(stored[0], [v, 0.0], rtol=1e-6)
        assert stored[1, 0] != pytest.approx(v, rel=1e-3)  # the living go on


def test_the_dead_are_passed_through_and_do_not_die_again():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1)
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    place[1] = [0.005, 0.0]
    arrange(env, place[None], dead=[0], hazard_threshold=0.01)
    step = env.step(still(env))
    assert not flat(env, "velocity").any()
    assert step.info["health"][0].sum() == 9  # contact with a dead agent kills nobody


def test_a_fork_in_which_a_moving_agent_dies_stops_it():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1)
    env.reset()
    for _ in range(3):
        env.step(np.ones((1, 4, 2)))
    before = flat(env, "position")[0].copy()
    step = env.load_rows(np.array([0]), env.fork(env.rows, {2: 0.0}))
    stored = env.layout.state.view(step.info["state"], "velocity")[0, 2].copy()
    step = env.step(np.ones((1, 4, 2)))
    assert (flat(env, "position")[0, 4:6] == before[4:6]).all()
    assert (flat(env, "position")[0, :4] != before[:4]).all()
    assert (env.layout.state.view(step.info["state"], "velocity")[0, 2] == stored).all()
    assert stored.any()


# ------------------------------------------------------------------------------------------ death laws


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_comm-10"])
@pytest.mark.parametrize(
    ("share", "risk"), [(0.0, 0.5), (0.25, 0.469), (0.5, 0.375), (0.75, 0.219), (0.9, 0.095), (1.01, 0.0)]
)
def test_hazard_kills_with_the_authors_probabilities(task, share, risk):
    worlds = 4000
    env = hipg_bench.make(task, num_envs=worlds, threads=1)
    radius = 0.05 if task == "paper_nav-4" else 0.1
    place = np.array([[0.0, 50.0 * (i + 1)] for i in range(env.num_agents)])
    place[1] = [share * radius, 0.0]
    marker = np.zeros((worlds, env.model.nmocap, 2))
    marker[:, :-1] = -99.0
    fields = (
        {"hazardous": np.arange(env.model.nmocap) == env.model.nmocap - 1} if task == "paper_nav-4" else {}
    )
    arrange(env, np.broadcast_to(place, (worlds, *place.shape)), marker=marker, **fields)
    alive = env.step(still(env)).info["alive"]
    assert alive[:, [0, 2, 3]].all()
    error = math.sqrt(risk * (1 - risk) / worlds)
    assert abs((~alive[:, 1]).mean() - risk) <= 4 * error + 5e-4  # the table has three digits
    # memoryless: of those who outlive the first step the same share dies in the second
    again = env.step(still(env)).info["alive"][alive[:, 1], 1]
    error = math.sqrt(risk * (1 - risk) / len(again))
    assert abs((~again).mean() - risk) <= 4 * error + 5e-4


def test_a_contact_kills_each_partner_with_probability_seven_tenths_independently():
    worlds = 4000
    env = hipg_bench.make("paper_comm-10", num_envs=worlds, threads=1)
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    # the push of 100 N/m x 10 mm = 1 N gives 0.1 m/s to each, 20 mm of gap in one step: come in faster
    place[1] = [0.01, 0.0]
    velocity = np.zeros((worlds, 20))
    velocity[:, 2] = -0.3  # 0.75 * 0.3 = 0.225 m/s towards each other, less 0.2 m/s apart
    place = np.broadcast_to(place, (worlds, 10, 2))
    arrange(env, place, velocity=velocity, marker=[[-1, -9], [1, -9], [9, -9]])
    step = env.step(still(env))
    dead = ~step.info["alive"]
    assert not dead[:, 2:].any()
    gap = np.linalg.norm(flat(env, "position")[:, :2] - flat(env, "position")[:, 2:4], axis=1)
    assert (gap < 0.02).all()
    error = math.sqrt(0.7 * 0.3 / worlds)
    assert abs(dead[:, 0].mean() - 0.7) < 4 * error
    assert abs(dead[:, 1].mean() - 0.7) < 4 * error
    both = (dead[:, 0] & dead[:, 1]).mean()
    assert abs(both - 0.49) < 4 * math.sqrt(0.49 * 0.51 / worlds)
    assert (env.get_field("death_cause")[dead] == env.definition.causes.index("collision")).all()


def test_collisions_kill_nobody_in_navigation():
    env = hipg_bench.make("paper_nav-4", num_envs=200, threads=1)
    corners = np.array([[0, 0], [0.01, 0], [0, 0.01], [0.01, 0.01]])
    arrange(env, np.broadcast_to(corners, (200, 4, 2)), hazardous=0)
    assert env.step(still(env)).info["alive"].all()


# ------------------------------------------------------------------------------------------ rewards


def navigation_reward(position, alive, points, hazardous, radius):
    """R by the authors' definition: sum over agents of each one's own term."""
    n, total = len(position), 0.0
    for i in range(n):
        for point, bad in zip(points, hazardous, strict=True):
            if not bad:
                total -= min(math.dist(point, other) for other in position)
        if alive[i]:
            total -= sum(j != i and math.dist(position[i], position[j]) < 2 * radius for j in range(n))
    return total


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_nav-8", "paper_coop_nav-3"])
def test_navigation_pays_what_the_authors_pay(task):
    worlds = 64
    env = hipg_bench.make(task, num_envs=worlds, threads=1, contact_stiffness=0.0)
    n = env.num_agents
    place = np.random.default_rng(3).uniform(-0.3, 0.3, (worlds, n, 2))
    arrange(env, place, dead=[1], hazard_threshold=np.inf)
    step = env.step(still(env))
    radius = 0.15 * math.sqrt(3 / n)
    position = flat(env, "position").reshape(worlds, n, 2)
    for b in range(worlds):
        alive = np.arange(n) != 1
        points, hazardous = env.get_field("point")[b, :, :2], flat(env, "hazardous")[b]
        assert len(points) == n + (task != "paper_coop_nav-3")
        assert hazardous.sum() == (task != "paper_coop_nav-3")
        expected = navigation_reward(position[b], alive, points, hazardous, radius)
        assert step.reward[b] == pytest.approx(expected, abs=1e-12)
    assert step.info["terms"]["collision"].any()
    assert step.info["terms"]["dead_overlap"].any()


def test_navigation_reward_of_one_arrangement_by_hand():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1)
    # agents 0 and 1 are 0.2 apart, nearer than 2 x 0.1299, and push: held by equal and opposite forces
    points = [[0, 0], [1, 0], [0, 3], [5, 5], [7, 7]]
    hazardous = [[0, 0, 0, 0, 1]]
    arrange(
        env, [[[0, 0], [0.2, 0], [1, 0.4], [1.1, 0.4]]], dead=[3], marker=points, hazardous=hazardous
    )  # fmt: skip
    push = 100 * (0.3 * math.sqrt(0.75) - 0.2)
    step = env.step(np.array([[[push, 0], [-push, 0], [0, 0], [0, 0]]]))
    # distances 0, 0.4 (agent 2, live), 2.6 + ... by agent 2 at (1, 0.4), and (1.1, 0.4) dead covers (5, 5)
    gaps = 0 + 0.4 + min(3.0, math.hypot(1, 2.6)) + math.hypot(3.9, 4.6)
    # one live pair overlaps: charged to both; agent 2 overlaps the dead agent 3: charged once
    assert step.reward[0] == pytest.approx(-4 * gaps - 2 - 1, abs=1e-9)
    assert step.info["terms"]["distance"][0] == pytest.approx(-4 * gaps, abs=1e-9)


def test_where_only_the_living_cover_the_dead_do_not():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1, dead_cover=False)
    points = [[0, 0], [0, 0], [0, 0], [0, 0], [7, 7]]
    place = [[[0, 0], [0, 1], [0, 2], [0, 3]]]
    arrange(env, place, dead=[0], marker=points, hazardous=[[0, 0, 0, 0, 1]])
    assert env.step(still(env)).reward[0] == pytest.approx(-4 * 4 * 1.0)
    arrange(env, place, dead=[0, 1, 2, 3], marker=points, hazardous=[[0, 0, 0, 0, 1]])
    assert env.step(still(env)).reward[0] == pytest.approx(-4 * 4 * 2.0)  # nobody: 2 m


def flooded(position, alive, terminals, reach):
    """Whether a chain of live agents links the terminals: breadth-first, in a plain loop."""
    nodes = [*terminals, *(p for p, a in zip(position, alive, strict=True) if a)]
    reached, edge = {0}, [0]
    while edge:
        node = edge.pop()
        for other in range(len(nodes)):
            both_terminals = node < 2 and other < 2
            if other not in reached and not both_terminals and math.dist(nodes[node], nodes[other]) <= reach:
                reached.add(other)
                edge.append(other)
    return 1 in reached


@pytest.mark.parametrize(("task", "reach"), [("paper_comm-10", 0.4368), ("paper_comm-16", 0.3704)])
def test_communication_pays_for_unbroken_chains_of_the_living(task, reach):
    worlds = 300
    env = hipg_bench.make(task, num_envs=worlds, threads=1, hazard_peak=0.0)
    n = env.num_agents
    assert link_range(env) == pytest.approx(reach, abs=5e-5)
    env.reset()
    terminals = env.get_field("point")[:, :2, :2].copy()
    rng = np.random.default_rng(5)
    # agents strewn along the line, so that about half of the worlds are linked
    along = (np.arange(n) + rng.uniform(-0.5, 0.5, (worlds, n))) / (n - 1)
    place = terminals[:, :1] + along[..., None] * (terminals[:, 1:] - terminals[:, :1])
    place += rng.normal(0, 0.08, place.shape)
    arrange(env, place, dead=[2], marker=env.get_field("point")[..., :2].copy())
    step = env.step(still(env))
    position = flat(env, "position").reshape(worlds, n, 2)
    alive = step.info["alive"]
    linked = [flooded(position[b], alive[b], terminals[b], link_range(env)) for b in range(worlds)]
    assert 0.1 < np.mean(linked) < 0.9
    assert step.reward.tolist() == [n * float(x) for x in linked]


def test_the_shortest_chain_breaks_when_one_relay_dies():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1)
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    # 4 relays are the fewest for 2 m at 0.4368 m
    place[:4] = [[-0.6, 0], [-0.2, 0], [0.2, 0], [0.6, 0]]
    marker = [[-1, 0], [1, 0], [0, 9]]
    arrange(env, place[None], marker=marker)
    assert env.step(still(env)).reward[0] == 10.0
    arrange(env, place[None], marker=marker, dead=[1])
    assert env.step(still(env)).reward[0] == 0.0
    # the terminals never hear each other directly
    arrange(
        env, np.array([[0.0, 50.0 * (i + 1)] for i in range(10)])[None], marker=[[-0.1, 0], [0.1, 0], [0, 9]]
    )
    assert env.step(still(env)).reward[0] == 0.0


# ------------------------------------------------------------------------------------------ layouts


@pytest.mark.parametrize(
    ("task", "direct", "state"),
    [
        ("paper_nav-4", 35, 45),
        ("paper_nav-8", 67, 85),
        ("paper_comm-10", 54, 65),
        ("paper_comm-16", 84, 95),
        ("paper_coop_nav-3", 24, 30),
    ],
)
def test_lengths_are_the_authors(task, direct, state):
    counted = 102 if "comm" in task else 162
    for observation, size in (("direct", direct), ("histogram", counted)):
        env = hipg_bench.make(task, num_envs=2, threads=1, observation=observation)
        step = env.reset()
        assert step.observation.shape == (2, env.num_agents, size)
        assert step.info["state"].shape == (2, state)
        assert env.layout.observation.blocks[0].name == env.layout.health_block == "terminated"
        assert len(env.layout.health_columns) == env.num_agents


def test_layouts_at_the_start_follow_the_authors_distributions():
    env = hipg_bench.make("paper_comm-10", num_envs=2000, threads=1)
    env.reset()
    marker, position = env.get_field("point")[..., :2], flat(env, "position")
    np.testing.assert_allclose(marker[:, 0], -marker[:, 1], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(marker[:, 0] - marker[:, 1], axis=1), 2.0)
    along = (marker[:, 2] * marker[:, 1]).sum(axis=1)
    np.testing.assert_allclose(marker[:, 2], along[:, None] * marker[:, 1], atol=1e-12)
    # uniform on (-0.9, 0.9): sd 0.9 / sqrt(3)
    assert abs(along).max() < 0.9
    assert abs(along.std() - 0.9 / math.sqrt(3)) < 0.02
    assert abs(position).max() < 1
    assert abs(position.std() - 1 / math.sqrt(3)) < 0.005
    env = hipg_bench.make("paper_nav-4", num_envs=2000, threads=1)
    env.reset()
    assert abs(env.get_field("point")[..., :2].std() - 1 / math.sqrt(3)) < 0.01
    share = flat(env, "hazardous").mean(axis=0)
    assert abs(share - 0.2).max() < 4 * math.sqrt(0.2 * 0.8 / 2000)


# ------------------------------------------------------------------------------------------ observations


def counted(observer, things):
    """Histogram by the authors' description, one thing at a time."""
    out = np.zeros((4, 8))
    edges = [0.1, 0.1 * 10 ** (1 / 3), 0.1 * 10 ** (2 / 3), 1.0]
    for x, y in things:
        dx, dy = x - observer[0], y - observer[1]
        distance = math.hypot(dx, dy)
        if distance <= 1.0:
            ring = sum(distance > edge for edge in edges)
            out[ring, round(math.degrees(math.atan2(dy, dx)) / 45) % 8] += 1
    return out


def test_ring_edges_are_the_authors():
    assert [round(float(edge), 4) for edge in plane.EDGES] == [0.1, 0.2154, 0.4642, 1.0]


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_nav-8", "paper_comm-10", "paper_coop_nav-3"])
def test_histograms_count_what_a_plain_loop_counts(task):
    worlds = 30
    env = hipg_bench.make(task, num_envs=worlds, threads=1)
    n = env.num_agents
    dead = [1] if n == 3 else [1, 3]
    step = arrange(env, np.random.default_rng(1).uniform(-1, 1, (worlds, n, 2)), dead=dead)
    position = flat(env, "position").reshape(worlds, n, 2)
    for b, i in itertools.product(range(worlds), range(n)):
        if i in dead:
            continue
        near = [position[b, j] for j in range(n) if j != i and j not in dead]
        np.testing.assert_array_equal(
            seen(env, step, "other_count", agent=i, world=b), counted(position[b, i], near)
        )
        gaps = sorted((position[b, j] - position[b, i] for j in dead), key=lambda gap: math.hypot(*gap))
        listed = seen(env, step, "dead_position", agent=i, world=b)
        np.testing.assert_allclose(listed[: len(dead)], gaps, atol=1e-6)
        assert not listed[len(dead) :].any()
        if "nav" in task:
            points = env.get_field("point")[b, flat(env, "revealed")[b] == 0, :2]
            np.testing.assert_array_equal(
                seen(env, step, "point_count", agent=i, world=b), counted(position[b, i], points)
            )


def test_histogram_cells_by_hand():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1)
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    place[1:6] = [[0.05, 0.0], [0.0, 0.15], [-0.3, -0.3], [0.0, -0.9], [1.01, 0.0]]
    step = arrange(env, place[None])
    expected = np.zeros((4, 8))
    # east in the first ring, north in the second, south-west at 0.424 in the third, south in the fourth;
    # the fifth is out of range
    expected[0, 0] = expected[1, 2] = expected[2, 5] = expected[3, 6] = 1
    np.testing.assert_array_equal(seen(env, step, "other_count"), expected)
    # and from the first neighbour: the observer lies west of it
    assert seen(env, step, "other_count", agent=1)[0, 4] == 1


def test_only_the_five_nearest_dead_are_listed_nearest_first_at_any_distance():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1)
    place = np.array([[0.0, 0.0]] + [[0.0, 20.0 - 2 * i] for i in range(9)])
    step = arrange(env, place[None], dead=[1, 2, 3, 4, 5, 6, 7])
    # agents 1..7 lie at 20, 18, ..., 8 m
    expected = [[0, 8], [0, 10], [0, 12], [0, 14], [0, 16]]
    np.testing.assert_allclose(seen(env, step, "dead_position"), expected)


def test_own_part_of_the_observation_and_the_joint_state():
    env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1, observation="direct")
    points = np.array([[0, 0.5], [1, 0], [0, 3], [5, 5], [7, 7.0]])
    velocity = np.arange(8.0)[None] / 10
    place = np.array([[[0.25, 0], [0.5, 2], [1, 0.5], [-1, 0.5]]])
    step = arrange(env, place, velocity=velocity, dead=[3], marker=points, hazardous=[[0, 1, 0, 0, 0]])
    assert seen(env, step, "terminated").tolist() == [0]
    np.testing.assert_allclose(seen(env, step, "velocity", agent=1), [0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(seen(env, step, "position", agent=1), [0.5, 2.0])
    np.testing.assert_allclose(seen(env, step, "point_position", agent=1), points - [0.5, 2.0])
    assert seen(env, step, "other_terminated", agent=1).tolist() == [0, 0, 1]  # of agents 0, 2, 3
    np.testing.assert_allclose(seen(env, step, "other_position", agent=1), [[-0.25, -2], [0.5, -1.5], [0, 0]])
    np.testing.assert_allclose(
        seen(env, step, "other_velocity", agent=1), [[-0.2, -0.2], [0.2, 0.2], [0, 0]], atol=1e-6
    )
    # a dead agent sees its own death and nothing else (in the authors' code it goes on seeing)
    assert step.observation[0, 3].tolist() == [1.0] + [0.0] * 34
    state, view = step.info["state"], env.layout.state.view
    assert view(state, "terminated").tolist() == [[0, 0, 0, 1]]
    assert view(state, "point_hazardous").tolist() == [[0, 1, 0, 0, 0]]
    np.testing.assert_allclose(view(state, "position"), place)
    np.testing.assert_allclose(view(state, "point_position")[0], points)
    assert not view(state, "point_velocity").any()


def test_direct_communication_hides_the_far_and_the_dead():
    env = hipg_bench.make("paper_comm-10", num_envs=1, threads=1, observation="direct")
    place = np.array([[0.0, 50.0 * i] for i in range(10)])
    place[1:4] = [[0.4, 0.0], [0.2, 0.0], [0.5, 0.0]]
    velocity = np.zeros((1, 20))
    velocity[0, 2:4] = [0.5, 0.25]
    step = arrange(env, place[None], velocity=velocity, dead=[2], marker=[[-1, 0], [1, 0], [0, 9]])
    position, speed = seen(env, step, "other_position"), seen(env, step, "other_velocity")
    np.testing.assert_allclose(position[0], [0.4, 0], rtol=1e-6)
    np.testing.assert_allclose(speed[0], [0.5, 0.25], rtol=1e-6)
    assert not position[1:].any()  # dead at 0.2, live at 0.5 > 0.4368, live far away
    assert not seen(env, step, "other_terminated").any()
    np.testing.assert_allclose(seen(env, step, "terminal_position"), [[-1, 0], [1, 0]])


def test_a_hazard_is_revealed_to_all_for_good_by_anyone_even_the_dead():
    points = [[0, 0], [1, 0], [0, 3], [5, 5], [-3, 0]]
    hazardous = [[1, 0, 0, 0, 0]]
    for observation, dead in itertools.product(("direct", "histogram"), ([], [0])):
        env = hipg_bench.make("paper_nav-4", num_envs=1, threads=1, observation=observation)
        place = [[[0.06, 0.0], [0, 2], [0, 9], [0.4, 0.0]]]
        step = arrange(env, place, marker=points, hazardous=hazardous, hazard_threshold=np.inf)
        step = env.step(still(env))
        tag = "point_revealed" if observation == "direct" else "hazard_position"
        assert not seen(env, step, tag, agent=1).any()
        place[0][0] = [0.04, 0.0]
        arrange(env, place, marker=points, hazardous=hazardous, hazard_threshold=np.inf, dead=dead)
        step = env.step(still(env))
        if observation == "direct":
            assert seen(env, step, tag, agent=1).tolist() == [1, 0, 0, 0, 0]
        else:
            np.testing.assert_allclose(seen(env, step, tag, agent=1), [0.0, -2.0], atol=1e-6)
            # the revealed hazard has left the histogram, point 1 at (0.6, 0) has not
            assert seen(env, step, "point_count", agent=3).sum() == 1
        for _ in range(20):
            step = env.step(np.broadcast_to([5.0, 0.0], (1, 4, 2)))
        assert seen(env, step, tag, agent=1).any()


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_comm-10"])
def test_the_previous_step_is_part_of_the_observation_and_of_the_row(task):
    env = hipg_bench.make(task, num_envs=60, threads=1)
    half = env.observation_size // 2
    rng = np.random.default_rng(0)
    last = env.reset()
    assert not last.observation[..., half:].any()
    for _ in range(20):
        step = env.step(5 * rng.standard_normal((60, env.num_agents, 2)))
        alive = step.info["alive"]
        np.testing.assert_array_equal(step.observation[alive][:, half:], last.observation[alive][:, :half])
        last = step
    assert not alive.all()
    other = hipg_bench.make(task, num_envs=60, threads=1, seed=9)
    other.reset()
    again = other.load_rows(np.arange(60), env.rows)
    np.testing.assert_array_equal(again.observation, step.observation)
    # and both go on alike
    action = rng.standard_normal((60, env.num_agents, 2))
    np.testing.assert_array_equal(other.step(action).observation, env.step(action).observation)


# ------------------------------------------------------------------------------------------ whole episodes


def play(task, policy, episodes, seed=0, **overrides):
    """Metrics of whole episodes, the return in learning-curve units: summed over agents too."""
    env = hipg_bench.make(task, num_envs=episodes, threads=1, seed=seed, **overrides)
    step = env.reset()
    for _ in range(50):
        step = env.step(policy(env, step))
    assert (step.info["end_reason"] == "horizon").all()
    metrics = step.info["metrics"]
    return {**metrics, "curve": env.num_agents * metrics["return"]}


def agree(sample, mean, sd, episodes):
    """Within three standard errors of both samples."""
    error = math.sqrt(sample.std(ddof=1) ** 2 / len(sample) + sd**2 / episodes)
    return abs(sample.mean() - mean) <= 3 * error


def zero(env, step):
    return still(env)


def normal(seed):
    rng = np.random.default_rng(seed)
    return lambda env, step: rng.standard_normal((env.num_envs, env.num_agents, 2))


def test_navigation_returns_and_deaths_are_those_of_the_authors_code():
    assert agree(play("paper_nav-4", zero, 2500)["curve"], -1784, 607, 200)
    played = play("paper_nav-4", normal(0), 2500)
    assert agree(played["curve"], -1857, 500, 200)
    # 0.04 deaths per episode, about Poisson
    assert agree(played["deaths"], 0.04, 0.2, 200)


def test_communication_deaths_are_those_of_the_authors_code():
    played = play("paper_comm-10", normal(0), 2500)
    assert agree(played["deaths"], 0.64, played["deaths"].std(), 200)
    assert played["curve"].mean() < 5  # "about 1", of a possible 5000
    assert (played["deaths"] == played["deaths_hazard"] + played["deaths_collision"]).all()
    harmless = play("paper_comm-10", normal(0), 2500, hazard_peak=0.0)
    assert agree(harmless["deaths"], 0.35, harmless["deaths"].std(), 200)
    assert not harmless["deaths_hazard"].any()


def formation(places, cap):
    """Assign agents to places once, nearest in sum, and hold them there with at most ``cap`` N per axis.

    The authors' gains are not known; these bring a particle to rest in about two steps.
    """
    target = []

    def act(env, step):
        position, velocity = (
            x.reshape(env.num_envs, -1, 2) for x in (flat(env, "position"), flat(env, "velocity"))
        )
        if not target:
            goals = places(env)
            for here, goal in zip(position, goals, strict=True):
                cost = np.linalg.norm(here[:, None] - goal[None], axis=-1)
                target.append(goal[linear_sum_assignment(cost)[1]])
        return np.clip(50 * (np.array(target) - position) - 7.5 * velocity, -cap, cap)

    return act


def safe_landmarks(env):
    hazardous = flat(env, "hazardous") > 0
    return env.get_field("point")[..., :2][~hazardous].reshape(env.num_envs, -1, 2)


def any_landmarks(env):
    # the layout is exchangeable, so the first n of n + 1 landmarks are a random choice
    return env.get_field("point")[:, : env.num_agents, :2]


def chain(env):
    ends = env.get_field("point")[:, :2, :2]
    share = (np.arange(env.num_agents) + 1) / (env.num_agents + 1)
    return ends[:, :1] + share[:, None] * (ends[:, 1:] - ends[:, :1])


@pytest.mark.parametrize(
    ("places", "cap", "curve", "deaths"),
    [
        (safe_landmarks, 1.0, -545, None),
        (safe_landmarks, 5.0, -231, None),
        (any_landmarks, 1.0, -809, 0.83),
        (any_landmarks, 5.0, -530, None),
    ],
)
def test_navigation_heuristics_earn_what_they_earn_in_the_authors_code(places, cap, curve, deaths):
    played = play("paper_nav-4", formation(places, cap), 2000)
    assert agree(played["curve"], curve, played["curve"].std(), 60)
    if deaths is not None:
        assert agree(played["deaths"], deaths, played["deaths"].std(), 60)


@pytest.mark.parametrize(
    ("cap", "peak", "curve"), [(5.0, 0.5, 4483), (5.0, 0.0, 4575), (1.0, 0.5, 3180), (1.0, 0.0, 3540)]
)
def test_communication_chain_earns_what_it_earns_in_the_authors_code(cap, peak, curve):
    played = play("paper_comm-10", formation(chain, cap), 2000, hazard_peak=peak)
    assert agree(played["curve"], curve, played["curve"].std(), 60)
    if (cap, peak) == (5.0, 0.5):
        assert agree(played["deaths"], 1.03, played["deaths"].std(), 60)
        assert agree(50 * played["connected"], 44.8, (50 * played["connected"]).std(), 60)


# ------------------------------------------------------------------- what the dead observe in training


def nearest_others(places, i, dead):
    """Relative places of the dead but agent i, nearest first, in five slots."""
    gaps = sorted((places[j] - places[i] for j in dead if j != i), key=lambda gap: math.hypot(*gap))
    return np.array([*gaps, *[np.zeros(2)] * 5][:5])


@pytest.mark.parametrize("task", ["paper_nav-4", "paper_comm-10"])
def test_live_observations_of_the_dead_are_those_of_the_authors(task):
    """A dead agent's row: flag 1, own motion, the other dead listed; it counts others in navigation only."""
    env = hipg_bench.make(task, num_envs=1, threads=1, dead_observation="live")
    n = env.num_agents
    places = np.random.default_rng(3).uniform(-0.7, 0.7, (n, 2))
    step = arrange(env, places[None], velocity=np.full((1, n, 2), 0.25), dead=(0, 2))
    points = env.get_field("point")[0, :, :2]
    for i in (0, 2):
        assert seen(env, step, "terminated", agent=i) == 1
        np.testing.assert_allclose(seen(env, step, "position", agent=i), places[i], atol=1e-6)
        listed = seen(env, step, "dead_position", agent=i)
        np.testing.assert_allclose(listed, nearest_others(places, i, (0, 2)), atol=1e-6)
        live = [places[j] - places[i] for j in range(n) if j not in (0, 2)]
        inside = sum(math.hypot(*gap) <= 1.0 for gap in live)
        assert seen(env, step, "other_count", agent=i).sum() == (inside if task == "paper_nav-4" else 0)
        if task == "paper_nav-4":
            near = sum(math.hypot(*(point - places[i])) <= 1.0 for point in points)
            assert seen(env, step, "point_count", agent=i).sum() == near
    blank = hipg_bench.make(task, num_envs=1, threads=1)
    other = arrange(blank, places[None], velocity=np.full((1, n, 2), 0.25), dead=(0, 2))
    living = [i for i in range(n) if i not in (0, 2)]
    np.testing.assert_array_equal(step.observation[0, living], other.observation[0, living])
    assert other.observation[0, 0].sum() == 1  # its flag alone


def test_the_dead_look_back_as_they_looked():
    """The previous step's half of a live dead agent's row is the row of the step before."""
    env = hipg_bench.make("paper_nav-4", num_envs=2, threads=1, dead_observation="live")
    before = arrange(env, np.random.default_rng(0).uniform(-0.7, 0.7, (2, 4, 2)), dead=(1,))
    after = env.step(np.full((2, 4, 2), 0.5))
    half = before.observation.shape[-1] // 2
    np.testing.assert_array_equal(after.observation[..., half:], before.observation[..., :half])
    again = env.load_rows(np.arange(2), env.rows)
    np.testing.assert_array_equal(again.observation, after.observation)
