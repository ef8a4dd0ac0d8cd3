"""Families by name: those of the benchmark, those that a program registers, those of packages and plug-ins.

A package offers a family as an entry point of the group ``hipg_bench.families``: the name that task files
use, and the module with the rules. A module that is not installed is a plug-in (`add_plugin`): an environment
variable names it, so that child processes know its families too. What a family does not declare, it has from
the family it names as its ``PARENT``; so a variant of a family holds what differs and nothing else.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path
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
PLUGINS = "HIPG_BENCH_PLUGINS"
"""Environment variable: modules or files with families, with ``os.pathsep`` between."""
_imported: set[str] = set()
"""Plug-ins whose import has begun: they ask for families themselves."""


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


def add_plugin(plugin: str) -> None:
    """Import a module with your own families, here and in all processes that this one starts.

    Args:
        plugin: a module's name or the path of its file (.py). It registers its families itself, or is a
            family, which has the module's name.

    Raises:
        SpecError: there is no such module or file, it fails, or it is no family.
    """
    if plugin.endswith(".py"):
        plugin = os.path.abspath(plugin)
    _import_plugin(plugin)
    before = os.environ.get(PLUGINS, "").split(os.pathsep)
    if plugin not in before:
        os.environ[PLUGINS] = os.pathsep.join(filter(None, [*before, plugin]))


def import_plugins() -> None:
    """Import the plug-ins that the environment names.

    Raises:
        SpecError: as in `add_plugin`.
    """
    for plugin in filter(None, os.environ.get(PLUGINS, "").split(os.pathsep)):
        _import_plugin(plugin)


def names() -> tuple[str, ...]:
    """Names of all families that are known."""
    import_plugins()
    return (*_BUILT_IN, *_registered, *_installed())


def module_of(name: str) -> ModuleType:
    """The module that a name stands for.

    Raises:
        SpecError: no such family.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    import_plugins()
    if name in _registered:
        return _registered[name]
    if name in _installed():
        return importlib.import_module(_installed()[name])
    raise SpecError(
        f"no family {name!r}{hint(name, names())}; one of your own needs --plugin MODULE or register_family"
    )


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


def _import_plugin(plugin: str) -> None:
    if plugin in _imported:
        return
    _imported.add(plugin)
    before = dict(_registered)
    try:
        module = _from_file(Path(plugin)) if plugin.endswith(".py") else importlib.import_module(plugin)
        if _registered == before:
            register_family(module.__name__.rpartition(".")[2], module)
    except Exception as error:
        _imported.remove(plugin)
        raise SpecError(f"plug-in {plugin}: {_why(plugin, error)}") from error


def _why(plugin: str, error: Exception) -> str:
    if isinstance(error, SpecError):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and error.name and plugin.startswith(error.name):
        return "no such module is installed; a file is named by its path, such as family.py"
    return f"{type(error).__name__}: {error}"


def _from_file(path: Path) -> ModuleType:
    """Import a file as the module of its name."""
    if not path.is_file():
        raise SpecError("there is no such file")
    name = path.stem
    if not name.isidentifier() or name in sys.modules or importlib.util.find_spec(name) is not None:
        raise SpecError(f"{name!r} is the name of another module: rename the file")
    found = importlib.util.spec_from_file_location(name, path)
    if found is None or found.loader is None:
        raise SpecError("it cannot be imported")
    module = sys.modules[name] = importlib.util.module_from_spec(found)
    try:
        found.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
