"""Agents on the Hugging Face Hub: a bundle goes there with its scores, and comes back as a stranger's.

What is pushed is what `submit pack` would pack, with a model card that the Hub can read: its ``model-index``
holds the scores of an evaluation of these very policies. What is pulled is checked by its names and sizes
before it is downloaded, and as `submit check` does before it appears under its name.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from hipg_bench import registry
from hipg_bench.errors import BundleError, HipgError
from hipg_bench.evaluation.comparing import read
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.paths import PARTIAL
from hipg_bench.policies.bundle import Agent, bundle_files, load_agent
from hipg_bench.submissions.archive import MOST_FILES, check_name, check_sizes
from hipg_bench.submissions.check import check

REPLAY = "replay.mp4"
"""The video that the Hub shows beside the model card."""
_NOT_THE_BUNDLES = re.compile(r"\.gitattributes|[^/]+\.mp4")
"""Files of a repository that a bundle does not hold: they are not downloaded."""
_OURS = "<!-- hipg-bench: what follows is written anew by each push -->"
_FRONT = re.compile(r"\A---\n.*?\n---\n+", re.DOTALL)


def stage(folder: Path, out: Path, repo: str, *, evaluation: Path | None, video: Path | None) -> None:
    """Write all that a push uploads into a new folder.

    Args:
        folder: the bundle's.
        out: the new folder, which must not exist.
        repo: where it will be uploaded, for the model card.
        evaluation: a folder that `evaluate` wrote for these policies; without one the card has no scores.
        video: of an episode, .mp4; by default the first film of the evaluation.

    Raises:
        BundleError: the bundle has errors, or the evaluation is of other policies.
        HipgError: no evaluation or video is there, or ``out`` exists.
    """
    if os.path.lexists(out):
        raise HipgError(f"{out} is there already: choose another folder")
    agent = load_agent(folder)
    _check_sound(agent.folder)
    results: Mapping[str, Any] = {} if evaluation is None else _scores_of(agent, evaluation)
    if video is None and evaluation is not None:
        video = next((evaluation / film["file"] for film in results["films"]), None)
    if video is not None and not (video.is_file() and video.suffix == ".mp4"):
        raise HipgError(f"{video}: an .mp4 file is expected as the video")
    with _new_folder(out) as made:
        for name, path in bundle_files(agent.folder).items():
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, made / name)
        (made / "README.md").write_text(_model_card(agent, repo, results), encoding="utf-8")
        (made / "config.json").write_text(json.dumps(_config(agent), indent=2) + "\n", encoding="utf-8")
        if evaluation is not None:
            shutil.copyfile(evaluation / "results.json", made / "results.json")
        if video is not None:
            shutil.copyfile(video, made / REPLAY)


def push(folder: Path, repo: str, *, private: bool = False) -> str:
    """Upload a folder of `stage`; files of an earlier push that are not in it are removed from the branch.

    Returns:
        The address of the commit.

    Raises:
        HipgError: the Hub refuses, or cannot be reached.
    """
    hub = _library()
    with _one_line_errors(repo):
        api = hub.HfApi()
        api.create_repo(repo, exist_ok=True, private=private)
        done = api.upload_folder(
            repo_id=repo, folder_path=folder, delete_patterns="*", commit_message="hipg-bench hub push"
        )
        return str(done.commit_url)


def pull(repo: str, out: Path | None, *, revision: str | None = None) -> tuple[Path, str]:
    """Download an agent, check it, and put it in place: all of it or nothing.

    Args:
        repo: ``USER/NAME``.
        out: the new folder; by default the agent's name, in the working folder.
        revision: a branch, tag or commit.

    Returns:
        The folder, and the commit that it is of.

    Raises:
        BundleError: it is no sound bundle.
        HipgError: there is no such repository, the Hub cannot be reached, or the folder exists.
    """
    hub = _library()
    if out is not None and os.path.lexists(out):
        raise HipgError(f"{out} is there already: choose another folder with --out")
    parent = (out or Path("here")).absolute().parent
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=PARTIAL, dir=parent) as temporary:
        with _one_line_errors(repo):
            api = hub.HfApi()
            commit = str(api.model_info(repo, revision=revision).sha)
            names = _declared(api.list_repo_tree(repo, recursive=True, revision=commit))
            for name in names:
                api.hf_hub_download(repo, name, revision=commit, local_dir=Path(temporary) / "hub")
        bundle = Path(temporary) / "bundle"
        for name in names:
            (bundle / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(temporary) / "hub" / name).rename(bundle / name)
        check_sizes({name: (bundle / name).stat().st_size for name in names})
        _drop_front_matter(bundle / "README.md")
        _check_sound(bundle, repo)
        target = out or Path(load_agent(bundle).name)
        if os.path.lexists(target):
            raise HipgError(f"{target} is there already: choose another folder with --out")
        bundle.rename(target)
    return target, commit


def _declared(tree: Iterator[Any]) -> list[str]:
    """The names of a bundle's files in a repository, each allowed, and all of a size that is."""
    sizes: dict[str, int] = {}
    for count, entry in enumerate(tree):
        if count > 2 * MOST_FILES:
            raise BundleError(f"at most {MOST_FILES} files are allowed")
        size = getattr(entry, "size", None)
        if size is None or _NOT_THE_BUNDLES.fullmatch(entry.path):  # a folder has no size
            continue
        check_name(entry.path)
        if entry.path.lower() in (name.lower() for name in sizes):
            raise BundleError(f"file {entry.path!r} is there twice, but for upper and lower case")
        sizes[entry.path] = size
    check_sizes(sizes)
    if "agent.toml" not in sizes:
        raise BundleError("the repository holds no agent.toml: it is no agent of hipg-bench")
    return list(sizes)


def _drop_front_matter(readme: Path) -> None:
    """Leave out what only the Hub reads: the card is shown as a page."""
    if readme.is_file():
        text = readme.read_text(encoding="utf-8", errors="replace")
        readme.write_text(_FRONT.sub("", text), encoding="utf-8")


def _check_sound(folder: Path, name: str | None = None) -> None:
    """Refuse a bundle that `submit check` would."""
    errors = [finding for finding in check(folder) if finding.severity == "error"]
    if errors:
        told = "".join(f"\n  {one.where}: {one.what}" for one in errors).replace(f"{folder}/", "")
        more = "" if name else f"\nhipg-bench submit check {folder} tells what to do"
        raise BundleError(f"{name or folder} has {len(errors)} error{'s' * (len(errors) > 1)}:{told}{more}")


def _scores_of(agent: Agent, evaluation: Path) -> Mapping[str, Any]:
    """The results of an evaluation, if it played the policies of this bundle and no others."""
    results = read(evaluation)
    for task in results["tasks"]:
        name = task["task"]
        path = evaluation / "episodes" / f"{name}.jsonl"
        rows = read_rows(path.read_bytes(), str(path), registry.task_spec(name))
        played = {int(row["train_seed"]): row["policy"] for row in rows}
        there = {seed: agent.fingerprint(name, seed) for seed in agent.train_seeds(name)}
        if played != there:
            raise BundleError(
                f"{evaluation} is of other policies than {agent.folder} holds for {name}: "
                f"hipg-bench evaluate --agent {agent.folder}"
            )
    return results


def _config(agent: Agent) -> dict[str, Any]:
    """What the bundle plays, for programs; the Hub counts downloads by this file."""
    from hipg_bench import __version__

    specs = registry.tasks()
    return {
        "library_name": "hipg-bench",
        "library_version": __version__,
        "name": agent.name,
        "kind": agent.card.kind,
        "suite": agent.card.suite,
        "tasks": {
            task: {
                "version": specs[task].version,
                "fingerprint": specs[task].fingerprint,
                "train_seeds": list(agent.train_seeds(task)),
            }
            for task in agent.tasks
        },
    }


def _model_card(agent: Agent, repo: str, results: Mapping[str, Any]) -> str:
    """The bundle's README with what the Hub reads before it and the scores behind it."""
    hub = _library()
    data = hub.ModelCardData(
        license=agent.card.license.lower(),
        library_name="hipg-bench",
        pipeline_tag="reinforcement-learning",
        tags=["hipg-bench", "multi-agent-reinforcement-learning", "mujoco", *agent.tasks],
        model_name=agent.name,
        eval_results=list(_eval_results(hub, results)) or None,
    )
    path = agent.folder / "README.md"
    text = _FRONT.sub("", path.read_text(encoding="utf-8")).partition(_OURS)[0].rstrip()
    return f"---\n{data.to_yaml()}\n---\n\n{text}\n\n{_OURS}\n\n{_scores(results)}{_usage(repo)}"


def _eval_results(hub: ModuleType, results: Mapping[str, Any]) -> Iterator[Any]:
    """Per task the mean return and, where it has anchors, the score."""
    for task in results.get("tasks", ()):
        numbers = {"mean_reward": ("mean return", task["return_mean"]), "score": ("score", task["score"])}
        for kind, (name, value) in numbers.items():
            if value is not None:
                yield hub.EvalResult(
                    task_type="reinforcement-learning",
                    task_name="multi-agent reinforcement learning",
                    dataset_type=task["task"],
                    dataset_name=f"{task['task']} v{task['version']}",
                    dataset_split=results["split"],
                    metric_type=kind,
                    metric_name=name,
                    metric_value=round(float(value), 4),
                )


def _scores(results: Mapping[str, Any]) -> str:
    """The scores as a table with intervals."""
    if not results:
        return ""
    lines = [
        f"## Scores\n\nMeans over {results['episodes_per_policy']} episodes per policy with 95 % intervals, "
        f"split `{results['split']}`. Score 0 is random actions, 1 the reference.\n",
        "| task | training seeds | score | team return | survival |\n|---|---|---|---|---|",
    ]
    for task in results["tasks"]:
        score = "-" if task["score"] is None else f"{task['score']:.2f} {_interval(task['score_ci95'])}"
        lines.append(
            f"| {task['task']} | {len(task['runs'])} | {score} | {task['return_mean']:.1f} "
            f"{_interval(task['return_ci95'], 1)} | {100 * task['survival']:.0f} % |"
        )
    return "\n".join(lines) + "\n\n"


def _interval(ends: list[float], digits: int = 2) -> str:
    return f"[{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def _usage(repo: str) -> str:
    name = repo.rpartition("/")[2]
    return (
        f"## Use it\n\n```\npip install 'hipg-bench[hub]'\nhipg-bench hub pull {repo} --out {name}\n"
        f"hipg-bench evaluate --agent {name}\n```\n"
    )


@contextlib.contextmanager
def _new_folder(out: Path) -> Generator[Path]:
    """A folder to fill that appears as ``out`` when it is whole."""
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=PARTIAL, dir=out.absolute().parent) as temporary:
        made = Path(temporary) / "new"
        made.mkdir()
        yield made
        made.rename(out)


@contextlib.contextmanager
def _one_line_errors(repo: str) -> Generator[None]:
    """Say in a line what the Hub or the network refuses."""
    hub = _library()
    try:
        yield
    except hub.errors.RepositoryNotFoundError as error:
        raise HipgError(
            f"{repo}: there is no such repository, or it is not yours to see: log in with `hf auth login`"
        ) from error
    except HipgError:
        raise
    except (hub.errors.HfHubHTTPError, OSError, ValueError, *_network_errors()) as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise HipgError(f"{repo}: {first}") from error


def _network_errors() -> list[type[Exception]]:
    """What the library's HTTP client raises, whichever it uses."""
    return [sys.modules[name].HTTPError for name in ("httpx", "httpx2") if name in sys.modules]


def _library() -> Any:
    try:
        hub = importlib.import_module("huggingface_hub")
    except ImportError as error:
        raise HipgError("the Hub needs huggingface_hub: pip install 'hipg-bench[hub]'") from error
    importlib.import_module("huggingface_hub.errors")
    importlib.import_module("huggingface_hub.utils").disable_progress_bars()
    return hub
