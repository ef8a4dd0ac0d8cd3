"""Films: what is in them, that they are whole or absent, and that motion between rows is the physics'."""

import colorsys
import itertools
import os
import signal
import subprocess
import sys
import time

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
import scipy.sparse.csgraph
from hypothesis import given, settings
from hypothesis import strategies as st

import hipg_bench
from hipg_bench import task_spec
from hipg_bench.errors import RenderError, UnknownNameError
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.families.known import declared
from hipg_bench.policies.bundle import load_agent
from hipg_bench.rendering import drones, film, gl, palette
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.hud import Caption, Hud, Reading
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.scene import Scene

SIZE = (320, 180)
FPS = 10


def played(task, steps, *, seed=0, **overrides):
    """An environment of one world and its rows (steps + 1, R) under random actions."""
    env = hipg_bench.make(task, 1, seed, threads=1, **overrides)
    env.reset()
    chance = np.random.default_rng(0)
    rows = [env.rows]
    for _ in range(steps):
        env.step(chance.uniform(-1, 1, (1, env.num_agents, env.action_size)))
        rows.append(env.rows)
    return env, np.concatenate(rows)


@pytest.fixture(scope="module")
def navigation():
    return played("hazard_nav-4", 5)


# films


@pytest.mark.parametrize("backend", gl.BACKENDS)
def test_a_film_has_the_size_the_rate_and_the_frames_that_were_asked_for(navigation, tmp_path, backend):
    probe = gl.probe(backend)
    if not probe.works:
        pytest.skip(f"{backend} does not work here: {probe.error}; {gl.INSTALL_COMMAND}")
    _, rows = navigation
    told = []
    film.record(
        "hazard_nav-4", rows, tmp_path / "a.mp4", agent="random", size=SIZE, fps=FPS, backend=backend,
        progress=lambda done, total: told.append((done, total)),
    )  # fmt: skip
    about = iio.immeta(tmp_path / "a.mp4", plugin="FFMPEG")
    frames = iio.imread(tmp_path / "a.mp4", plugin="FFMPEG")
    # 0.5 s at half speed is 1 s: 10 intervals, 11 frames; then the end card for 1.6 s
    assert frames.shape == (11 + 16, SIZE[1], SIZE[0], 3)
    assert about["fps"] == FPS
    assert about["codec"] == "h264"
    assert told == [(k, 27) for k in range(1, 28)]
    assert frames.std(axis=(1, 2, 3)).min() > 5
    assert list(tmp_path.iterdir()) == [tmp_path / "a.mp4"]


def test_the_same_rows_give_the_same_film_and_a_spec_does_as_well_as_its_name(navigation, tmp_path):
    env, rows = navigation
    film.record("hazard_nav-4", rows[:3], tmp_path / "a.mp4", agent="random", size=SIZE, fps=FPS)
    film.record(env.spec, rows[:3], tmp_path / "b.mp4", agent="random", size=SIZE, fps=FPS)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_a_film_shows_who_is_dead(navigation, tmp_path):
    env, rows = navigation
    dead = env.fork(rows, {1: 0.0})
    last = {}
    for name, states in (("alive", rows), ("dead", dead)):
        film.record(env.spec, states, tmp_path / f"{name}.mp4", agent="random", size=(640, 360), fps=2)
        last[name] = iio.imread(tmp_path / f"{name}.mp4", plugin="FFMPEG", index=2).astype(float)
    scene = Scene(Trajectory(env.spec, rows))
    scene.update(0.5)
    places = np.stack([scene.visuals.place(i) for i in range(4)])
    pixel, _ = scene.camera(0.5).project(places, 640, 360)
    change, colourful = [], []
    for x, y in pixel.round().astype(int):
        patch = {name: frame[y - 8 : y + 9, x - 12 : x + 13] for name, frame in last.items()}
        change.append(np.abs(patch["dead"] - patch["alive"]).mean())
        colourful.append({name: np.ptp(part, axis=-1).mean() for name, part in patch.items()})
    assert int(np.argmax(change)) == 1
    # a wreck is charred: what remains of its hue is the floor's
    assert colourful[1]["dead"] < 0.65 * colourful[1]["alive"]


def test_an_animated_picture_has_the_frames_and_their_duration(navigation, tmp_path):
    _, rows = navigation
    film.record("hazard_nav-4", rows[:2], tmp_path / "a.gif", agent="random", size=SIZE, fps=FPS)
    # 0.1 s at half speed: 2 intervals, 3 frames; then the end card for 1.6 s
    assert iio.improps(tmp_path / "a.gif", index=None, plugin="pillow").shape == (19, SIZE[1], SIZE[0], 3)
    assert iio.immeta(tmp_path / "a.gif", index=1, plugin="pillow")["duration"] == 1000 / FPS


def test_a_gif_of_an_episode_is_small_by_default(tmp_path):
    """The busiest picture there is: sixteen drones and their links, moving about at random."""
    spec = task_spec("hazard_comm-16")
    plan = EvaluationJob(episodes=1, threads=1)
    policy = load_agent("random").policy(spec)
    row = plan.play(spec, policy, [0])[0]
    film.record(spec, plan.record(spec, policy, row), tmp_path / "a.gif", agent="random")
    assert iio.improps(tmp_path / "a.gif", index=0, plugin="pillow").shape == (270, 480, 3)
    assert (tmp_path / "a.gif").stat().st_size < 5_000_000


_WITH_AND_WITHOUT_SKY = """
import sys, mujoco, hipg_bench
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.renderer import Renderer, views
from hipg_bench.rendering.scene import Scene
env = hipg_bench.make(sys.argv[1], 1, 0, threads=1)
env.reset()
trajectory = Trajectory(env.spec, env.rows)
with Renderer(trajectory.model, 640, 360) as renderer:
    (view,) = views(Scene(trajectory), [0.0], 360)
    asked = bool(view.mjv_scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX])
    pictures = []
    for sky in (0, 1):
        view.mjv_scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = sky
        pictures.append(renderer.render(view.mjv_scene))
print(asked, bool((pictures[0] != pictures[1]).any()))
"""


@pytest.mark.parametrize("task", ["hazard_nav-8", "hazard_comm-16", "paper_nav-8", "multiwalker-5"])
def test_the_sky_is_painted_where_it_can_be_seen(task):
    backend = gl.working_backend()
    if backend is None:
        pytest.skip(f"no OpenGL works here; {gl.INSTALL_COMMAND}")
    done = subprocess.run(
        [sys.executable, "-c", _WITH_AND_WITHOUT_SKY, task],
        env=gl.environment(backend), capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    visible = str(task.startswith("multiwalker"))
    assert done.stdout.split() == [visible, visible]


# failures


def test_a_backend_that_does_not_exist_is_told(navigation, tmp_path):
    _, rows = navigation
    with pytest.raises(RenderError, match="MUJOCO_GL: nonsense") as caught:
        film.record("hazard_nav-4", rows, tmp_path / "a.mp4", agent="random", backend="nonsense")
    assert gl.INSTALL_COMMAND not in str(caught.value), "nothing that could be installed is missing"
    assert list(tmp_path.iterdir()) == []
    assert gl.working_backend(("nonsense",)) is None


@pytest.mark.parametrize(
    ("task", "name", "size", "error", "match"),
    [
        ("hazard_nav-4", "a.avi", SIZE, RenderError, r"\.mp4 or \.gif"),
        ("hazard_nav-4", "a.mp4", (321, 180), RenderError, "even sizes"),
        ("hazard_nav-5", "a.mp4", SIZE, UnknownNameError, "hazard_nav-"),
        ("hazard_nav-8", "a.mp4", SIZE, RenderError, "rows of shape"),
    ],
)
def test_what_cannot_be_filmed_is_refused(navigation, tmp_path, task, name, size, error, match):
    _, rows = navigation
    with pytest.raises(error, match=match):
        film.record(task, rows, tmp_path / name, agent="random", size=size)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_recording_leaves_nothing_behind(navigation, tmp_path, how):
    _, rows = navigation
    np.save(tmp_path / "rows.npy", rows)
    out = tmp_path / "films" / "a.mp4"
    code = (
        "import signal, sys, numpy as np; from pathlib import Path; from hipg_bench.rendering import film\n"
        # where these tests run in the background, they and their children ignore Ctrl-C
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "film.record('hazard_nav-4', np.load(sys.argv[1]), Path(sys.argv[2]), agent='a', size=(640, 360), "
        "fps=120)"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "rows.npy"), str(out)],
        stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        assert _within(60, lambda: out.parent.exists() and any(out.parent.iterdir())), "the film never began"
        if how == signal.SIGINT:
            os.killpg(parent.pid, how)  # as Ctrl-C in a terminal does
        else:
            parent.kill()
        parent.wait(30)
        assert _within(30, lambda: not any(out.parent.iterdir()))
    finally:
        parent.kill()


def _within(seconds, condition):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


# motion between rows


def test_at_a_row_the_picture_is_the_row(navigation):
    env, rows = navigation
    trajectory = Trajectory(env.spec, rows)
    data = mujoco.MjData(trajectory.model)
    for row, moment in zip(rows, trajectory.time, strict=True):
        trajectory.show(float(moment))
        mujoco.mj_setState(trajectory.model, data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(trajectory.model, data)
        np.testing.assert_allclose(trajectory.data.xpos, data.xpos, atol=1e-12)


def test_between_rows_drones_are_where_the_physics_had_them(navigation):
    env, rows = navigation
    trajectory = Trajectory(env.spec, rows)
    data = mujoco.MjData(env.model)
    limit = env.model.jnt_range
    curved, straight = [], []
    for k in range(1, 5):
        mujoco.mj_setState(env.model, data, rows[k + 1], mujoco.mjtState.mjSTATE_INTEGRATION)
        control, end = data.ctrl.copy(), data.qpos.copy()
        mujoco.mj_setState(env.model, data, rows[k], mujoco.mjtState.mjSTATE_INTEGRATION)
        data.ctrl[:] = control  # a row holds the control that led to it
        start = data.qpos.copy()
        # a bounce off the floor or a wall is no smooth curve
        free = (np.minimum(start, end) > limit[:, 0] + 0.05) & (np.maximum(start, end) < limit[:, 1] - 0.05)
        for substep in range(1, env.decimation):
            mujoco.mj_step(env.model, data)
            trajectory.show(0.1 * (k + substep / env.decimation))
            share = substep / env.decimation
            curved.append(np.abs(trajectory.data.qpos - data.qpos)[free].max())
            straight.append(np.abs((1 - share) * start + share * end - data.qpos)[free].max())
        mujoco.mj_step(env.model, data)
        np.testing.assert_allclose(data.qpos, end, atol=1e-9)
    assert max(curved) < 0.0015
    assert max(curved) < max(straight) / 4


def test_bodies_turn_half_way_at_half_time():
    env, rows = played("multiwalker-3", 6)
    trajectory = Trajectory(env.spec, rows)
    root = trajectory.body("walker0/torso")
    place = slice(*(trajectory.model.jnt_qposadr[trajectory.model.body_jntadr[root]] + np.array([3, 7])))
    turns = np.zeros((3, 3))
    pose = []
    for moment in (0.08, 0.09, 0.10):
        trajectory.show(moment)
        pose.append(trajectory.data.qpos[place].copy())
    assert np.linalg.norm(pose[1]) == pytest.approx(1)
    mujoco.mju_subQuat(turns[0], pose[2], pose[0])
    mujoco.mju_subQuat(turns[1], pose[1], pose[0])
    assert np.linalg.norm(turns[0]) > 1e-3
    np.testing.assert_allclose(turns[1], turns[0] / 2, atol=1e-5)


def test_footage_ends_where_another_episode_begins():
    env, rows = played("coop_nav-3", 7, horizon=4)
    assert env.get_field("elapsed", rows).tolist() == [0, 1, 2, 3, 0, 1, 2, 3]
    trajectory = Trajectory(env.spec, rows)
    assert len(trajectory.rows) == 4
    live = Trajectory(env.spec, rows[:1])
    lengths = []
    for row in rows[1:]:
        live.append(row)
        lengths.append(len(live.rows))
    assert lengths == [2, 3, 4, 1, 2, 3, 4]
    np.testing.assert_array_equal(live.body_position, Trajectory(env.spec, rows[4:]).body_position)


def test_footage_knows_since_when(navigation):
    env, rows = navigation
    rows = np.concatenate([rows[:3], env.fork(rows[3:], {2: 0.0})])
    revealed = env.get_field("revealed", rows)
    revealed[4:, 0] = 1.0
    rows = env.set_field(rows, "revealed", revealed)
    trajectory = Trajectory(env.spec, rows)
    # row 3 is at 0.3 s, row 4 at 0.4 s
    np.testing.assert_allclose(trajectory.lifetime, [np.inf, np.inf, 0.3, np.inf])
    assert trajectory.since("revealed", 0.35)[0] < 0
    assert trajectory.since("revealed", 0.45)[0] == pytest.approx(0.05)
    assert trajectory.remembered(0.29)["health"][2] == 1
    assert trajectory.remembered(0.3)["health"][2] == 0


def test_rows_that_are_not_finite_are_refused(navigation):
    env, rows = navigation
    bad = rows.copy()
    bad[2, 3] = np.nan
    with pytest.raises(RenderError, match="row 2"):
        Trajectory(env.spec, bad)


# scenes


@pytest.mark.parametrize("task", sorted(hipg_bench.tasks()))
def test_every_task_can_be_drawn_and_everyone_is_numbered(task):
    env, rows = played(task, 3)
    scene = Scene(Trajectory(env.spec, env.fork(rows, {0: 0.0})))
    mjv_scene = mujoco.MjvScene(scene.trajectory.model, maxgeom=8000)
    shapes = mjv_scene.ngeom
    scene.update(2.5 * env.spec.control_step)
    labels, status = scene.decorate(mjv_scene, 2.5 * env.spec.control_step)
    words = [label.text for label in labels]
    assert "1 \N{MULTIPLICATION X}" in words
    # random actions may have killed others, too
    assert {str(agent + 1) for agent in range(env.num_agents)} <= {word.split()[0] for word in words}
    assert mjv_scene.ngeom > shapes
    assert env.spec.family not in ("hazard_comm", "paper_comm", "multiwalker") or status


def test_every_family_has_a_look():
    assert all(declared(spec.family, "RENDERING") for spec in hipg_bench.tasks().values())


def test_places_fall_where_mujoco_draws_them(navigation):
    env, rows = navigation
    trajectory = Trajectory(env.spec, rows)
    trajectory.show(0.0)
    camera = Camera(np.array([0.1, -0.2, 0.4]), 3.0, 70.0, -25.0)
    mjv_scene, option = mujoco.MjvScene(trajectory.model, maxgeom=2000), mujoco.MjvOption()
    every = int(mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(trajectory.model, trajectory.data, option, None, camera.mujoco(), every, mjv_scene)
    eye, other = mjv_scene.camera[:2]
    ahead, up = np.asarray(eye.forward), np.asarray(eye.up)
    gap = trajectory.data.xpos[1:5] - (np.asarray(eye.pos) + np.asarray(other.pos)) / 2
    # pinhole: the picture's upper edge is at frustum_top when the plane at frustum_near is looked at
    scale = 180 / eye.frustum_top * eye.frustum_near / (gap @ ahead)
    expected = np.stack([320 + scale * (gap @ np.cross(ahead, up)), 180 - scale * (gap @ up)], axis=-1)
    pixel, depth = camera.project(trajectory.data.xpos[1:5], 640, 360)
    np.testing.assert_allclose(pixel, expected, atol=0.01)
    np.testing.assert_allclose(depth, gap @ ahead, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(nodes=st.integers(3, 12), share=st.floats(0.1, 0.9), seed=st.integers(0, 10_000))
def test_the_chain_drawn_is_a_shortest_one(nodes, share, seed):
    upper = np.triu(np.random.default_rng(seed).random((nodes, nodes)) < share, 1)
    links = upper | upper.T
    links[0, 1] = links[1, 0] = False
    hops = scipy.sparse.csgraph.shortest_path(links.astype(float), unweighted=True)[0, 1]
    if np.isfinite(hops):
        chain = drones._chain(links)
        assert len(chain) == hops + 1
        assert (chain[0], chain[-1]) == (0, 1)
        assert all(links[a, b] for a, b in itertools.pairwise(chain))


@pytest.mark.parametrize("num_agents", [2, 4, 10, 16, 31])
def test_nobody_is_painted_in_the_colour_of_danger(num_agents):
    colours = palette.team(num_agents)
    assert colours.min() >= 0
    assert colours.max() <= 1
    danger = colorsys.rgb_to_hsv(*palette.DANGER)[0]
    for colour in colours:
        apart = abs(colorsys.rgb_to_hsv(*colour)[0] - danger)
        assert min(apart, 1 - apart) > 0.06
    assert np.linalg.norm(np.diff(colours, axis=0), axis=1).min() > 0.02


@pytest.mark.parametrize("num_agents", [2, 16, 31])
def test_a_bar_is_as_long_as_health(num_agents):
    colour = palette.team(num_agents)
    caption = Caption("task", "agent", "legend", 1.0, 10.0, colour)
    hud = Hud(caption, 1280, 720)
    camera = Camera(np.zeros(3), 1.0, 90.0, -20.0)
    health = np.linspace(0.0, 1.0, num_agents)
    frame = np.zeros((720, 1280, 3), np.uint8)
    seen = np.asarray(hud.write(frame, camera, [], Reading(1.0, 2.0, health, []))).astype(int)
    panel = seen[98:, 62:275]
    for agent in range(num_agents):
        own = (np.abs(panel - (255 * colour[agent]).round()).max(axis=-1) <= 1).sum(axis=1).max()
        assert own == (0 if health[agent] == 0 else pytest.approx(213 * health[agent], abs=14))


# commands


def _command(*words, **environment):
    return subprocess.run(
        [sys.executable, "-c", "from hipg_bench.cli import main; main()", *words],
        capture_output=True, text=True, timeout=120, env={**os.environ, **environment}, check=False,
    )  # fmt: skip


def test_video_plays_and_films_an_episode(tmp_path):
    out = tmp_path / "new" / "a.mp4"
    done = _command(
        "video", "--task", "coop_nav-3", "--agent", "zero", "--episode", "3", "--out", str(out),
        "--width", "160", "--height", "90", "--fps", "2",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    # 5 s at half speed, 2 frames/s: 21 frames; and the end card for 1.6 s: 3 frames
    assert iio.imread(out, plugin="FFMPEG").shape == (21 + 3, 90, 160, 3)
    assert "horizon" in done.stdout


def test_view_without_a_display_says_what_to_do():
    done = _command("view", "--task", "coop_nav-3", "--agent", "zero", DISPLAY="", WAYLAND_DISPLAY="")
    assert done.returncode == 2
    assert "hipg-bench video" in done.stderr
    assert "Traceback" not in done.stderr
