"""What the standard specs claim of themselves: the score scale, and that their tasks are about health.

The quick tests hold what the task files say against thresholds; `make test-long` measures it again.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import hipg_bench
from hipg_bench import make, task_spec
from hipg_bench.evaluation import calibration

STANDARD = sorted(hipg_bench.tagged("standard"))
ANCHORED = [task for task in sorted(hipg_bench.tasks()) if task_spec(task).anchors]
PROBES = ("score_zero", "score_constant", "score_time_only")


@pytest.mark.parametrize("task", STANDARD)
def test_the_scale_is_measured_and_wide(task: str):
    spec = task_spec(task)
    assert spec.anchors, f"{task} has no anchors: hipg-bench calibrate {task}"
    random, reference = spec.anchors.random, spec.anchors.reference
    assert random.episodes >= 1000
    for anchor in (random, reference):
        assert anchor.ci95[0] <= anchor.mean <= anchor.ci95[1]
    assert spec.floor < random.ci95[0]
    assert random.ci95[1] < reference.ci95[0]


@pytest.mark.parametrize("task", STANDARD)
def test_the_file_says_that_policies_without_eyes_score_little(task: str):
    calibration = task_spec(task).calibration
    for probe in PROBES:
        assert calibration[probe] < 0.2, probe


@pytest.mark.parametrize("task", [task for task in STANDARD if task.startswith("hazard")])
def test_the_file_says_that_the_hazard_matters(task: str):
    assert task_spec(task).calibration["hazard_sensitivity"] >= 0.25


@pytest.mark.parametrize("task", ANCHORED)
def test_random_play_still_earns_its_anchor(task: str):
    """A fresh sample of random episodes, within 4.5 standard errors."""
    spec, worlds = task_spec(task), 96
    assert spec.anchors
    env, rng = make(task, worlds, seed=11, threads=1), np.random.default_rng(3)
    step, total, running = env.reset(), np.zeros(worlds), np.ones(worlds, bool)
    while running.any():
        step = env.step(rng.uniform(-1, 1, (worlds, env.num_agents, env.action_size)))
        total += np.where(running, step.reward, 0.0)
        running &= ~(step.terminated | step.truncated)
    low, high = spec.anchors.random.ci95
    error = math.hypot((high - low) / (2 * 1.96), total.std(ddof=1) / math.sqrt(worlds))
    assert abs(total.mean() - spec.anchors.random.mean) < 4.5 * error + 1e-9


@pytest.mark.long
@pytest.mark.parametrize("task", STANDARD)
def test_what_the_file_says_is_measured_again(task: str):
    """300 fresh episodes per policy; scores of 300 episodes have standard errors of 0.02 or less."""
    spec = task_spec(task)
    measured = calibration.calibrate(spec, 300, threads=1, progress=lambda name, done: None).spec
    for probe in PROBES:
        assert measured.calibration[probe] < 0.2, probe
        assert measured.calibration[probe] == pytest.approx(spec.calibration[probe], abs=0.1)
    if task.startswith("hazard"):
        assert measured.calibration["hazard_sensitivity"] >= 0.2
