"""Verdicts and figures on sets of runs whose answer is known."""

import csv
import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from typer.testing import CliRunner

from hipg_bench.cli import app
from hipg_bench.comparison import claims, page
from hipg_bench.comparison.artefacts import BUNDLES, bundle_name
from hipg_bench.comparison.cards import _SUMMARIES
from hipg_bench.comparison.figures import _ALGORITHMS, FAMILIES, band_of, draw_all
from hipg_bench.comparison.improvement import Improvement, improvement
from hipg_bench.comparison.traces import Trace, blocks, traces
from hipg_bench.errors import BundleError, HipgError
from hipg_bench.learning.settings import ALGORITHMS
from hipg_bench.registry import task_spec, tasks

STEPS = np.linspace(1e4, 1e6, 50)


def run(algorithm, task, seed, final, score=None, warm=False):
    """A run that rises straight to what it reaches."""
    score = final * STEPS / STEPS[-1] if score is None else score
    return Trace(algorithm, task, seed, STEPS, score, True, warm, final)


def named(judged, words, suite="paper"):
    (found,) = [one for one in judged if words in one.claim and one.suite == suite]
    return found


def campaign(suite, level, seeds=4, noise=0.02):
    """Runs of every algorithm around its level on the tasks of a suite."""
    rng = np.random.default_rng(0)
    return [
        run(algorithm, task, seed, at + noise * rng.normal())
        for task in claims.SUITES[suite]
        for algorithm, at in level.items()
        for seed in range(seeds)
    ]


def test_improvement_by_hand() -> None:
    # pairs: 3 > 1, 3 > 2, 3 = 3; 1 = 1, 1 < 2, 1 < 3: (1 + 1 + .5 + .5) / 6 = .5;
    # 5, 6 against 4: 1; the mean of both tasks .75
    x, y = np.array([3.0, 1.0]), np.array([1.0, 2.0, 3.0])
    assert improvement([(x, y)]).p == pytest.approx(0.5)
    both = improvement([(x, y), (np.array([5.0, 6.0]), np.array([4.0]))])
    assert both.p == pytest.approx(0.75)
    assert both.ci95[0] <= both.p <= both.ci95[1]


@pytest.mark.parametrize(("n", "chance"), [(2, 1 / 3), (3, 1 / 10), (4, 2 / 70), (5, 2 / 252)])
def test_few_runs_cannot_be_sure(n: int, chance: float) -> None:
    """Fully apart: 2 of the (2n choose n) ways to deal the labels are as far from 1/2."""
    found = improvement([(np.arange(n) + 10.0, np.arange(n) + 0.0)], reps=20_000)
    assert found.ci95 == (1.0, 1.0), "the bootstrap alone would be sure of two runs"
    assert found.chance == pytest.approx(chance, abs=0.01)
    assert (claims.verdict(found) == "holds") == (n >= 4)


def test_permutation_agrees_with_mann_whitney() -> None:
    from scipy import stats

    rng = np.random.default_rng(3)
    x, y = rng.normal(0.8, 1, 6), rng.normal(0, 1, 5)
    expected = stats.mannwhitneyu(x, y, alternative="two-sided", method="exact").pvalue
    assert improvement([(x, y)], reps=20_000).chance == pytest.approx(expected, abs=0.01)


def test_nothing_between_the_algorithms_is_undecided() -> None:
    """And the test's level is what it says: of 200 sets without any difference, about 5 % pass."""
    rng = np.random.default_rng(1)
    verdicts = [
        claims.verdict(improvement([(rng.normal(size=4), rng.normal(size=4)) for _ in range(3)], reps=400))
        for _ in range(200)
    ]
    passed = sum(one in ("holds", "does not hold") for one in verdicts)
    assert passed <= 20, "binomial(200, .05) exceeds 20 once in a thousand"


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        (Improvement(0.9, (0.6, 1.0), (0.7, 1.0), 0.01, 5), "holds"),
        (Improvement(0.9, (0.6, 1.0), (0.7, 1.0), 0.06, 5), "undecided"),
        (Improvement(0.7, (0.4, 0.9), (0.45, 0.85), 0.01, 5), "undecided"),
        (Improvement(0.1, (0.0, 0.3), (0.0, 0.25), 0.01, 5), "does not hold"),
        (Improvement(0.1, (0.0, 0.3), (0.0, 0.25), 0.2, 5), "undecided"),
        (Improvement(0.52, (0.42, 0.61), (0.44, 0.59), 0.7, 5), "no difference"),
        (Improvement(0.5, (0.5, 0.5), (0.5, 0.5), 1.0, 1), "undecided"),
        (Improvement(0.52, (0.38, 0.66), (0.41, 0.61), 0.7, 5), "undecided"),
    ],
)
def test_the_rule(found: Improvement, verdict: str) -> None:
    assert claims.verdict(found) == verdict


def test_what_was_built_in_is_found() -> None:
    level = {"min_health": 0.9, "central": 0.7, "local": 0.5, "maddpg": 0.2}
    judged = claims.judge_all(campaign("paper", level))
    for words in ("min-health is above central", "central is above local", "local is above MADDPG"):
        one = named(judged, words)
        assert one.verdict == ("holds" if "without" not in one.claim else "too few runs")
        assert one.runs == (24, 24)
    assert named(judged, "lead over central grows").verdict == "undecided"
    assert named(judged, "QMIX").verdict == "too few runs"
    assert {one.verdict for one in judged if one.suite == "standard"} == {"too few runs"}
    backwards = claims.judge_all(campaign("paper", {"min_health": 0.5, "central": 0.7}))
    assert named(backwards, "min-health is above central").verdict == "does not hold"


def test_tasks_with_too_few_runs_are_left_out_and_named() -> None:
    runs = [run("min_health", "paper_nav-4", seed, 0.9) for seed in range(4)]
    runs += [run("central", "paper_nav-4", seed, 0.8) for seed in range(4)]
    runs += [run("min_health", "paper_nav-8", 0, 0.9), run("central", "paper_nav-8", 0, 0.1)]
    judged = claims.judge_all(runs)
    level = named(judged, "min-health is above central")
    assert level.strata == ("paper_nav-4", "paper_nav-8")
    assert "paper_comm-10" in level.missing
    assert level.runs == (5, 5)


def test_runs_that_began_with_anothers_policy_are_left_out() -> None:
    cold = [
        run(algorithm, "paper_nav-4", seed, 0.5)
        for algorithm in ("min_health", "central")
        for seed in range(4)
    ]
    warm = [run("min_health", "paper_nav-4", seed, 0.9, warm=True) for seed in range(4, 8)]
    one = named(claims.judge_all(cold + warm), "min-health is above central")
    assert (one.runs, one.found.p) == ((4, 4), 0.5)


def test_tasks_that_contradict_each_other_are_seen_one_by_one() -> None:
    """Better by much on two tasks and worse by much on two: pooled nothing, each by itself clear."""
    rng, lead = np.random.default_rng(3), dict(zip(claims.STANDARD, (0.3, 0.3, -0.3, -0.3), strict=True))
    runs = [
        run(algorithm, task, seed, (lead[task] if algorithm == "min_health" else 0) + 0.02 * rng.normal())
        for task in claims.STANDARD
        for algorithm in ("min_health", "central")
        for seed in range(6)
    ]
    one = named(claims.judge_all(runs), "min-health is above central", "standard")
    assert one.found.p == 0.5
    assert one.verdict not in ("holds", "does not hold")
    assert [one.by_stratum[task].verdict for task in claims.STANDARD] == ["holds"] * 2 + ["does not hold"] * 2
    # fully apart, 6 against 6: 2 / 924 = 0.0022; the smallest of four is multiplied by 4
    corrected = [one.by_stratum[task].found.chance for task in claims.STANDARD]
    assert min(corrected) == pytest.approx(4 * 2 / 924, abs=0.006)


def test_many_equal_runs_show_no_difference() -> None:
    """P lies within 0.5 +- 0.1 with a 90 % interval of 1.64 * sqrt(2 / (12 * 160)) = 0.053 either way."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=160)
    assert claims.verdict(improvement([(values, np.roll(values, 1))], reps=2000)) == "no difference"


def test_one_run_of_each_arm_on_six_tasks_is_a_sign_test() -> None:
    tasks = [*claims.STANDARD, *claims.WALKERS]
    runs = [
        run(algorithm, task, 0, level)
        for task in tasks
        for algorithm, level in (("central", 0.9), ("local", 0.5))
    ]
    one = named(claims.judge_all(runs), "central is above local", suite="standard")
    assert one.found is not None
    assert one.found.chance == pytest.approx(2 / 2**6, abs=0.01)  # all six fall the same way, either way
    assert one.verdict == "holds"
    five = named(claims.judge_all(runs[:-2]), "central is above local", suite="standard")
    assert five.verdict == "undecided"  # 2 / 2**5 is above 0.05


def test_a_lead_that_grows_with_the_team() -> None:
    rng = np.random.default_rng(2)
    leads = {"hazard_nav-4": 0.0, "hazard_nav-8": 0.3, "hazard_comm-10": 0.1, "hazard_comm-16": 0.5}
    runs = [
        run(algorithm, task, seed, 0.5 + (lead if algorithm == "min_health" else 0) + 0.01 * rng.normal())
        for task, lead in leads.items()
        for algorithm in ("min_health", "central")
        for seed in range(5)
    ]
    one = named(claims.judge_all(runs), "lead over central grows", "standard")
    assert one.strata == ("hazard_nav-4 to hazard_nav-8", "hazard_comm-10 to hazard_comm-16")
    assert (one.verdict, one.found.p) == ("holds", 1.0)


def test_learning_first_and_then_no_more() -> None:
    """Local: 0.6 (1 - e^(-20 t)), there at once; central: t."""
    share, rng = STEPS / STEPS[-1], np.random.default_rng(5)
    curves = {"local": 0.6 * (1 - np.exp(-20 * share)), "central": share}
    runs = [
        run(algorithm, task, seed, score[-1], score + 0.02 * rng.normal(size=len(score)))
        for task in claims.SUITES["paper"]
        for algorithm, score in curves.items()
        for seed in range(4)
    ]
    judged = claims.judge_all(runs)
    for words in ("local learns first", "local plateaus", "central is above local"):
        assert named(judged, words).verdict == "holds", words
    # by hand: between 40 and 60 % central is at 0.5 on average, from 80 % on at 0.9
    late = claims.late_gains([run("central", "paper_nav-4", 0, 1.0, share)])
    assert late[0] == pytest.approx(0.4, abs=0.02)


def test_blocks_are_means_of_neighbours() -> None:
    steps, score = blocks(np.arange(6.0), np.array([0, 2, 4, 6, 8, 10.0]), most=3)
    np.testing.assert_allclose(steps, [0.5, 2.5, 4.5])
    np.testing.assert_allclose(score, [1, 5, 9])


def test_bands_by_hand() -> None:
    runs = [run("central", "paper_nav-4", k, at) for k, at in enumerate([0.0, 0.1, 0.2, 0.3, 5.0])]
    steps, middle, low, high = band_of(runs, "range")
    share = steps / STEPS[-1]
    np.testing.assert_allclose(middle, 1.12 * share, atol=1e-9)
    np.testing.assert_allclose(low, 0 * share, atol=1e-9)
    np.testing.assert_allclose(high, 5 * share, atol=1e-9)
    _, middle, low, high = band_of(runs, "iqm")
    np.testing.assert_allclose(middle, 0.2 * share, atol=1e-9, err_msg="of five the middle three count")
    assert (low <= middle).all()
    assert (high >= middle).all()


def worth(task: str, score: float) -> float:
    """The return of a score: 0 is the random anchor, 1 the reference."""
    anchors = task_spec(task).anchors
    return anchors.random.mean + score * (anchors.reference.mean - anchors.random.mean)


def write(agents: Path, algorithm: str, task: str, seed: int, rows, final=None) -> None:
    place = agents / bundle_name(algorithm) / task
    place.mkdir(parents=True, exist_ok=True)
    with (place / f"seed{seed}.curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["steps", "return", "eval_return"], restval="")
        writer.writeheader()
        writer.writerows(rows)
    record = {} if final is None else {"result": {"return": worth(task, final)}}
    (place / f"seed{seed}.json").write_text(json.dumps(record))


@pytest.fixture
def agents(tmp_path: Path) -> Path:
    folder = tmp_path / "agents"
    rng = np.random.default_rng(0)
    for algorithm, top in (("min_health", 0.8), ("central", 0.5), ("central-masked", 0.6)):
        for seed in range(4):
            rows = [
                {
                    "steps": 1000 * k,
                    "return": -1.0,
                    "eval_return": worth("paper_comm-10", top * k / 20 + 0.01 * rng.normal()),
                }
                for k in range(1, 21)
            ]
            write(folder, algorithm, "paper_comm-10", seed, rows, final=top + 0.01 * rng.normal())
    return folder


def test_curves_come_from_trials_and_else_from_training(agents: Path) -> None:
    spec = task_spec("hazard_nav-4")
    low, high = spec.anchors.random.mean, spec.anchors.reference.mean
    halfway = (low + high) / 2
    write(agents, "local", "hazard_nav-4", 7, [{"steps": 100 * k, "return": halfway} for k in range(1, 21)])
    found = traces(agents)
    assert {(one.algorithm, one.task) for one in found} == {
        ("min_health", "paper_comm-10"),
        ("central", "paper_comm-10"),
        ("central-masked", "paper_comm-10"),
        ("local", "hazard_nav-4"),
    }
    (old,) = [one for one in found if one.algorithm == "local"]
    assert not old.evaluated
    assert old.seed == 7
    np.testing.assert_allclose(old.score, 0.5)
    assert old.final == pytest.approx(0.5), "without a measured score, the curve's end"
    assert all(one.evaluated for one in found if one.algorithm != "local")
    # returns of a training that paid otherwise than the task are no scores
    record = agents / "mappo_local" / "hazard_nav-4" / "seed7.json"
    record.write_text(json.dumps({"settings": {"weights": {"alive": 0.1}}}))
    assert "local" not in {one.algorithm for one in traces(agents)}


def test_runs_of_a_task_are_compared_by_one_measurement(agents: Path) -> None:
    """One run without periodic evaluations: all of the task are shown by their training's returns."""
    rows = [{"steps": 1000 * k, "return": worth("paper_comm-10", 0.25)} for k in range(1, 21)]
    write(agents, "central", "paper_comm-10", 9, rows, final=0.75)
    found = traces(agents)
    assert not any(one.evaluated for one in found)
    (added,) = [one for one in found if one.seed == 9]
    np.testing.assert_allclose(added.score, 0.25)
    assert added.final == pytest.approx(0.75)


def test_figures_and_page(agents: Path, tmp_path: Path) -> None:
    text = f"# Mine\n\nbefore\n\n{page.BEGIN}\noutdated\n{page.END}\n\nafter\n"
    (tmp_path / "page.md").write_text(text)
    out = tmp_path / "out"
    options = ["--agents", str(agents), "--out", str(out), "--page", str(tmp_path / "page.md")]
    done = CliRunner().invoke(app, ["figures", *options])
    assert done.exit_code == 0, done.output
    assert {path.name for path in out.iterdir()} == {
        "paper.png", "paper_iqm.png", "masking.png", "masking_iqm.png", "verdicts.json"
    }  # fmt: skip
    assert all(imageio.imread(path).std() > 10 for path in out.glob("*.png"))
    verdicts = json.loads((out / "verdicts.json").read_text())
    first = next(one for one in verdicts if one["claim"] == "min-health is above central")
    assert (first["verdict"], first["p_improvement"], first["runs"]) == ("holds", 1.0, [4, 4])
    assert sum(one["verdict"] == "too few runs" for one in verdicts) > 10
    content = (tmp_path / "page.md").read_text()
    assert content.startswith("# Mine\n\nbefore\n")
    assert content.endswith("\nafter\n")
    assert "outdated" not in content
    assert "| min-health is above central | paper | paper_comm-10 (too few runs: paper_nav-4" in content
    assert "(out/paper.png)" in content
    # the same runs, the same bytes
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    CliRunner().invoke(app, ["figures", *options])
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert (tmp_path / "page.md").read_text() == content


def test_what_cannot_be_drawn_is_said(tmp_path: Path) -> None:
    with pytest.raises(HipgError, match="collect"):
        CliRunner().invoke(app, ["figures", "--agents", str(tmp_path)], catch_exceptions=False)
    (tmp_path / "page.md").write_text("no marks")
    with pytest.raises(HipgError, match="no place"):
        page.write_results(tmp_path / "page.md", "text")
    assert draw_all([], tmp_path / "none") == []


def test_every_task_and_algorithm_that_is_named_exists() -> None:
    shown = {task for panels in FAMILIES.values() for task in panels}
    compared = {task for suite in claims.SUITES.values() for task in suite}
    assert shown | compared <= set(tasks())
    assert set(ALGORITHMS) == set(BUNDLES) == set(_SUMMARIES) == set(_ALGORITHMS), (
        "all can be collected and drawn"
    )
    assert len({bundle_name(algorithm) for algorithm in BUNDLES}) == len(BUNDLES)
    with pytest.raises(BundleError, match="own credit rules"):
        bundle_name("my_rules:half_shared")
    assert bundle_name("central-masked_batch") == "mappo_central_masked_batch"
