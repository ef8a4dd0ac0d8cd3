"""Records: named numbers and arrays that rules read and write, laid out from a class of annotations.

A class says what a record holds, e.g. ``position: Float[np.ndarray, "N 3"]``, ``elapsed: float``. Axes are
letters whose sizes a task gives, so that one class, and one piece of machine code, serves teams of any size.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, get_type_hints

import numpy as np

from hipg_bench.layout import Layout

_SCALARS: Mapping[Any, type] = {float: np.float64, int: np.int64, bool: np.uint8}
_ARRAYS: Mapping[str, type] = {
    "float64": np.float64, "float32": np.float32, "int64": np.int64, "int32": np.int32, "bool": np.uint8,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Field:
    """One named entry of a record.

    Attributes:
        name: what it is.
        number: its NumPy type; truth values are stored as ``uint8``, which GPUs can address.
        axes: letters or sizes of its axes; none for a single number.
    """

    name: str
    number: type
    axes: tuple[str, ...] = ()


def fields(kind: type) -> tuple[Field, ...]:
    """Entries of a record class, those of its bases first.

    Raises:
        TypeError: an annotation that is neither a number nor a jaxtyping array of numbers.
    """
    return tuple(_field(name, hint) for name, hint in get_type_hints(kind).items())


def _field(name: str, hint: Any) -> Field:
    if hint in _SCALARS:
        return Field(name, _SCALARS[hint])
    dims = getattr(hint, "dim_str", None)
    if dims is None:
        raise TypeError(f"{name}: float, int, bool and jaxtyping arrays are allowed, got {hint}")
    # `Float` allows several widths: the widest is meant
    width = next((number for text, number in _ARRAYS.items() if text in hint.dtypes), None)
    if width is None:
        raise TypeError(f"{name}: arrays of {', '.join(_ARRAYS)} are allowed, got {hint}")
    return Field(name, width, tuple(dims.split()))


def layout_fields(layout: Layout) -> tuple[Field, ...]:
    """Entries of a flat float32 vector: the blocks of its layout."""
    return tuple(
        Field(block.name, np.float32, tuple(str(size) for size in block.shape)) for block in layout.blocks
    )


def shape(field: Field, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Sizes of a field's axes; a letter may carry a factor, as in ``2*K``."""
    return tuple(
        math.prod(sizes[part] if part in sizes else int(part) for part in axis.split("*"))
        for axis in field.axes
    )


def dtype(entries: tuple[Field, ...], sizes: Mapping[str, int]) -> np.dtype[np.void]:
    """NumPy's type of a record that stands alone, aligned."""
    return np.dtype([(entry.name, entry.number, shape(entry, sizes)) for entry in entries], align=True)


def places(kind: np.dtype[np.void]) -> dict[str, tuple[tuple[int, ...], Any, int]]:
    """Shape, number type and offset in bytes of each entry of a record."""
    found: Mapping[Any, Any] = kind.fields or {}
    return {name: (part.shape, part.base, offset) for name, (part, offset, *_) in found.items()}


def packed(layout: Layout) -> np.dtype[np.void]:
    """NumPy's type of a flat float32 vector."""
    return np.dtype([(block.name, np.float32, block.shape) for block in layout.blocks])
