"""What only the hosting service reads is well formed, and agrees with the project."""

import tomllib
from pathlib import Path

import pytest
import yaml

import hipg_bench

ROOT = Path(__file__).parent.parent
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")


def read(path: Path) -> dict:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_are_well_formed(path):
    workflow = read(path)
    assert workflow["name"]
    # YAML 1.1 reads the key `on` as true
    assert {"push", "pull_request"} & set(workflow[True])
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert job["runs-on"].startswith("ubuntu-")
        assert job["timeout-minutes"] <= 60
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step), step
            for word in str(step.get("run", "")).split():
                if word.startswith((".ci/", "scripts/")):
                    assert (ROOT / word).is_file()


def test_the_workflows_run_what_must_pass():
    runs = [
        step.get("run", "")
        for path in WORKFLOWS
        for job in read(path)["jobs"].values()
        for step in job["steps"]
    ]
    assert ".ci/run" in runs
    assert any("python -m build" in run for run in runs)


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_issue_forms_are_well_formed(path):
    form = read(path)
    assert form["name"]
    assert form["description"]
    ids = [field["id"] for field in form["body"]]
    assert len(set(ids)) == len(ids) > 0
    assert all(field["attributes"]["label"] for field in form["body"])


def test_the_citation_is_of_this_version():
    citation = read(ROOT / "CITATION.cff")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == project["version"] == hipg_bench.__version__
    assert citation["license"] == project["license"]
    assert citation["authors"]
    assert citation["authors"][0]["name"] == project["authors"][0]["name"]


def test_targets_that_contributors_are_told_of_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines()
    told = {line.split()[1] for line in lines if line.startswith("make ")}
    assert {"setup", "lint", "test"} <= told
    assert all(f"\n{target}:" in makefile for target in told)
