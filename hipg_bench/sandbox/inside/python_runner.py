"""Tier 2: the agent is a Python function's, ``module:make_agent`` in the submission's folder."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from typing import Any


def make(setup: Mapping[str, Any]) -> Any:
    """Import the module from ``folder`` and call its function with the task and the training seed.

    Raises:
        AttributeError: the module has no such function.
        ImportError: there is no such module, or one that it needs is not installed here.
    """
    module, _, function = setup["options"]["entry_point"].partition(":")
    sys.path.insert(0, setup["folder"])
    return getattr(importlib.import_module(module), function)(setup["task"], setup["train_seed"])
