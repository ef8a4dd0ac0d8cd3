"""Pictures of worlds: `BatchEnv.render`, what `repr` says, and what a notebook shows."""

from __future__ import annotations

import base64
import copy
import io
import os
import re
import subprocess

import mujoco
import numpy as np
import pytest
from PIL import Image

import hipg_bench
from hipg_bench import processes
from hipg_bench.errors import HipgError, RenderError, SpecError
from hipg_bench.rendering import gl, live

pytestmark = pytest.mark.skipif(gl.working_backend() is None, reason=f"no OpenGL: {gl.INSTALL_COMMAND}")
SIZE = {"width": 320, "height": 180}


@pytest.fixture
def env():
    made = hipg_bench.make("hazard_nav-4", 3, seed=0, threads=1)
    yield made
    made.close()


def play(env, steps):
    action = np.full((env.num_envs, env.num_agents, env.action_size), 0.7)
    for _ in range(steps):
        step = env.step(action)
    return step


def difference(one, other):
    """Share of pixels that differ clearly."""
    return (np.abs(one.astype(int) - other).max(axis=-1) > 24).mean()


def test_a_picture_changes_with_the_world_and_with_nothing_else(env):
    env.reset()
    first, other = env.render(**SIZE), env.render(2, **SIZE)
    assert (first.shape, first.dtype) == ((180, 320, 3), np.uint8)
    assert first.std() > 5
    assert difference(first, other) > 0.003  # points and drones lie elsewhere
    np.testing.assert_array_equal(env.render(**SIZE), first)
    before = env.rows
    play(env, 6)
    assert difference(env.render(**SIZE), first) > 0.003
    env.load_rows(np.arange(3), before)
    np.testing.assert_array_equal(env.render(**SIZE), first)


def test_a_dead_agent_looks_dead_at_once(env):
    env.reset()
    play(env, 3)
    alive = env.render(1, width=640, height=360)
    env.load_rows(np.array([1]), env.fork(env.rows[1:2], {0: 0.0}))
    forked = env.render(1, width=640, height=360)
    env.arrange(np.array([1]), health=np.array([[0.0, 1.0, 1.0, 1.0]]))
    # the first agent's bar of health: orange while it lives, a dark red after it died
    bar = np.s_[50:60, 40:100]
    assert alive[bar].max(axis=(0, 1))[1] > 140
    assert forked[bar].max(axis=(0, 1))[1] < 100
    # beside the panels, where only the world is: its colour is gone, and no flash hides that
    world = np.s_[90:330, 150:]
    assert difference(alive[world], forked[world]) > 0.0005
    assert orange(forked[world]) < 0.3 * orange(alive[world])


def orange(picture):
    """Pixels in the first agent's hue."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    return int(((red > 150) & (green > 90) & (green < red - 30) & (blue < green - 40)).sum())


def test_the_plank_of_a_single_picture_has_gone_as_far_as_in_the_world():
    from hipg_bench.rendering.motion import Trajectory
    from hipg_bench.rendering.painter import Painter
    from hipg_bench.rendering.scene import Scene

    env = hipg_bench.make("multiwalker-3", 1, threads=1)
    env.reset()
    env.arrange(displacement=2.5)
    trajectory = Trajectory(env.spec, env.rows)
    scene = Scene(trajectory)
    scene.update(0.0)
    painter = Painter(mujoco.MjvScene(trajectory.model, 4000), scene.camera(0.0), 360)
    said = [status.text for status in scene._look.decorate(painter, 0.0)]
    assert said == ["plank +2.50 m", "3 of 3 on their feet"]


def test_a_fresh_process_draws_without_a_display_and_loads_no_graphics():
    code = (
        "import sys, hipg_bench; env = hipg_bench.make('coop_nav-3', 1, compiled=False); env.reset();"
        "loaded = [name for name in sys.modules if name.startswith('hipg_bench.rendering')];"
        "assert loaded == [], loaded;"
        "print(env.render(width=64, height=80).shape); assert 'OpenGL' not in sys.modules"
    )
    without = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run(
        processes.python("-c", code), env=without, capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stdout.strip()) == (0, "(80, 64, 3)"), done.stderr


def test_what_cannot_be_drawn_is_refused_with_what_is_allowed(env):
    with pytest.raises(RenderError, match="before reset"):
        env.render()
    env.reset()
    with pytest.raises(SpecError, match=r"world = 3 is refused: a whole number in 0\.\.2"):
        env.render(3)
    with pytest.raises(SpecError, match=r"width = 5000 is refused: a whole number in 64\.\.4096"):
        env.render(width=5000)
    env.close()
    with pytest.raises(HipgError, match="closed"):
        env.render()


def test_the_child_that_draws_is_started_again_after_it_was_killed_and_ends_with_the_environment(env):
    env.reset()
    first = env.render(**SIZE)
    child = env._pictures._child._process
    child.kill()
    child.wait()
    with pytest.raises(RenderError, match="ended by signal 9"):
        env.render(**SIZE)
    np.testing.assert_array_equal(env.render(**SIZE), first)
    np.testing.assert_array_equal(copy.deepcopy(env).render(**SIZE), first)
    child = env._pictures._child._process
    env.close()
    assert child.poll() is not None


def test_repr_says_what_runs_and_where_it_is(env):
    begin = "<BatchEnv hazard_nav-4, num_envs=3, 4 agents, seed=0, compiled, 1 thread, "
    assert repr(env) == begin + "not yet reset>"
    env.reset()
    play(env, 5)
    assert repr(env) == begin + "world 0: episode 0 after 5 steps, 0 dead>"
    env.load_rows(np.array([0]), env.fork(env.rows[:1], {2: 0.0, 3: 0.0}))
    assert repr(env) == begin + "world 0: episode 0 after 5 steps, 2 dead>"
    env.close()
    assert repr(env) == begin + "closed>"
    assert "not compiled, 2 threads" in repr(hipg_bench.make("coop_nav-3", 2, threads=2, compiled=False))


def test_a_notebook_shows_a_picture_and_the_same_facts(env, monkeypatch):
    assert "<img" not in env._repr_html_()
    env.reset()
    page = env._repr_html_()
    (code,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(base64.b64decode(code)))), env.render())
    assert "hazard_nav-4, num_envs=3, 4 agents, seed=0" in page

    def fails(*_):
        raise RenderError("no <OpenGL> works\nmore")

    monkeypatch.setattr(live.Stills, "picture", fails)
    page = env._repr_html_()
    assert "<img" not in page
    assert "no picture: no &lt;OpenGL&gt; works</div>" in page
