"""What a family's module says in words: its rules, its numbers, its reward terms and its metrics."""

import inspect
import re
from collections.abc import Mapping

from hipg_bench.families.family import Family

RULES = ("Agents", "Reward", "Hazard", "End")
"""The headings of the paragraph of rules with which the docstring of every family begins."""


def rules(family: Family) -> Mapping[str, str]:
    """Heading to sentences of the family's rules.

    Raises:
        ValueError: the docstring has no such paragraph.
    """
    module = inspect.getmodule(family.Params)
    text = " ".join((inspect.getdoc(module) or "").split("\n\n")[1].split())
    parts = re.split(rf"\b({'|'.join(RULES)}): ", text)
    found = dict(zip(parts[1::2], parts[2::2], strict=True))
    if tuple(found) != RULES or parts[0]:
        raise ValueError(f"{module}: the second paragraph of its docstring has to say {', '.join(RULES)}")
    return {heading: _sentence(found[heading]) for heading in RULES}


def param_meanings(family: Family) -> Mapping[str, str]:
    """Name of a family's number to what it is, from the docstrings of its ``Params``."""
    meanings: dict[str, str] = {}
    for kind in reversed(family.Params.__mro__):
        documentation = inspect.getdoc(kind) if "__doc__" in vars(kind) else None
        if documentation and "Attributes:\n" in documentation:
            listed = documentation.partition("Attributes:\n")[2]
            entries = re.findall(r"^    ([\w, ]+): (.*(?:\n {8}.*)*)", listed, re.MULTILINE)
            for names, text in entries:
                meanings |= dict.fromkeys(names.split(", "), " ".join(text.split()).rstrip("."))
    return meanings


def field_meanings(record: type) -> Mapping[str, str]:
    """Field of a record to the comment behind it, those of its bases included."""
    meanings: dict[str, str] = {}
    for kind in reversed(record.__mro__[:-1]):
        source = inspect.getsource(kind)
        meanings |= dict(re.findall(r"^    (\w+): [\w.]+(?:\[.*\])?(?:  # (.*))?$", source, re.MULTILINE))
    return meanings


def _sentence(text: str) -> str:
    text = text.strip()
    return text[0].upper() + text[1:]
