"""Families by name: those of the benchmark, those that a program registers, and those of installed packages.

A package offers a family as an entry point of the group ``hipg_bench.families``: the name that task files
use, and the module with the rules. What a family does not declare, it has from the family it names as its
``PARENT``; so a variant of a family holds what differs and nothing else.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

from hipg_bench.errors import SpecError, hint
from hipg_bench.families import hazard_comm, hazard_nav, multiwalker, paper_comm, paper_nav
from hipg_bench.families.family import Definition, complete, define
from hipg_bench.spec import TaskSpec

_BUILT_IN: Mapping[str, ModuleType] = {
    "hazard_nav": hazard_nav,
    "hazard_comm": hazard_comm,
    "multiwalker": multiwalker,
    "paper_nav": paper_nav,
    "paper_comm": paper_comm,
}
_GROUP = "hipg_bench.families"
_registered: dict[str, ModuleType] = {}


def register_family(name: str, module: ModuleType) -> None:
    """Make a family known by a name in this process.

    Args:
        name: as in the ``family`` of a task file.
        module: with the declarations and rules, see `hipg_bench.families.family.Family`.

    Raises:
        SpecError: another family has this name, or the module lacks something.
    """
    if name in _BUILT_IN or _registered.get(name, module) is not module:
        raise SpecError(f"there is another family {name!r}: choose a different name")
    complete(name, module, [module_of(parent) for parent in _ancestors(module)])
    _registered[name] = module


def names() -> tuple[str, ...]:
    """Names of all families that are known."""
    return (*_BUILT_IN, *_registered, *_installed())


def module_of(name: str) -> ModuleType:
    """The module that a name stands for.

    Raises:
        SpecError: no such family.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    if name in _registered:
        return _registered[name]
    if name in _installed():
        return importlib.import_module(_installed()[name])
    raise SpecError(f"no family {name!r}{hint(name, names())}")


def definition_of(spec: TaskSpec) -> Definition:
    """Work out what a task's family says of its numbers.

    Raises:
        SpecError: unknown family, or a number of the family that is not allowed.
    """
    try:
        module = module_of(spec.family)
    except SpecError as error:
        raise SpecError(f"{spec.task}: {error}") from error
    return define(spec, complete(spec.family, module, [module_of(name) for name in _ancestors(module)]))


def lineage(name: str) -> tuple[str, ...]:
    """A family's name, then those of the families from which it has what it does not declare."""
    return (name, *_ancestors(module_of(name)))


def declared(name: str, what: str) -> Any:
    """What a family, or the nearest of its lineage, declares under a name; None where none does.

    A text ``module:object`` stands for that object: a family can so name what must not be imported with it.
    """
    for each in lineage(name):
        value = getattr(module_of(each), what, None)
        if value is not None:
            return pkgutil.resolve_name(value) if isinstance(value, str) else value
    return None


def _ancestors(module: ModuleType) -> tuple[str, ...]:
    parent = getattr(module, "PARENT", None)
    return () if parent is None else (parent, *_ancestors(module_of(parent)))


@functools.cache
def _installed() -> dict[str, str]:
    """Families of installed packages: name to module."""
    return {point.name: point.value for point in entry_points(group=_GROUP) if point.name not in _BUILT_IN}
