"""What Numba must be told, so that rules can read and write records by name.

In machine code a record is two addresses: of its numbers, and of the part of the address table that says
where each entry begins and how long its axes are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_untracked
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    register_model,
)
from numba.np import numpy_support
from numba.np.arrayobj import make_array, populate_array

from hipg_bench.records import Field


class RecordType(types.Type):
    """A kind of record: the names, number types and numbers of axes of its entries."""

    def __init__(self, name: str, entries: tuple[Field, ...]) -> None:
        self.entries: dict[str, tuple[int, Any, int]] = {}
        position = 0
        for entry in entries:
            number = numpy_support.from_dtype(np.dtype(entry.number))
            self.entries[entry.name] = position, number, len(entry.axes)
            position += 1 + len(entry.axes)
        super().__init__(
            name=f"Record({name}, {[(e.name, e.number.__name__, len(e.axes)) for e in entries]})"
        )

    def entry_type(self, name: str) -> Any:
        """Numba's type of an entry; None where there is no such entry."""
        if name not in self.entries:
            return None
        _, number, axes = self.entries[name]
        return types.Array(number, axes, "C") if axes else number


@register_model(RecordType)
class _RecordModel(models.StructModel):
    def __init__(self, manager: Any, kind: RecordType) -> None:
        members = [("numbers", types.voidptr), ("table", types.CPointer(types.int64))]
        super().__init__(manager, kind, members)


@infer_getattr
class _RecordAttributes(AttributeTemplate):
    key = RecordType

    def generic_resolve(self, kind: RecordType, name: str) -> Any:
        return kind.entry_type(name)


def accessor(name: str, entries: tuple[Field, ...], start: int) -> Any:
    """A function of (table, k) that returns record k; its part of the table begins at ``start``."""
    kind = RecordType(name, entries)

    @intrinsic
    def record_at(context: Any, table: Any, k: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            table_type = signature.args[0]
            words = make_array(table_type)(context, builder, arguments[0]).data
            record = cgutils.create_struct_proxy(kind)(context, builder)
            address, stride = (_word(builder, words, start + i) for i in range(2))
            index = context.cast(builder, arguments[1], signature.args[1], types.int64)
            address = builder.add(address, builder.mul(stride, index))
            record.numbers = builder.inttoptr(address, cgutils.voidptr_t)
            record.table = builder.gep(words, [ir.Constant(ir.IntType(64), start + 2)])
            return record._getvalue()

        return kind(table, k), build

    return record_at


def _word(builder: Any, words: Any, index: int) -> Any:
    """A number of the table; none changes while machine code runs, so that it may be kept in a register."""
    loaded = builder.load(builder.gep(words, [ir.Constant(ir.IntType(64), index)]))
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def _place(context: Any, builder: Any, kind: RecordType, value: Any, name: str) -> tuple[Any, Any]:
    """Address of an entry's first number, and the record."""
    record = cgutils.create_struct_proxy(kind)(context, builder, value=value)
    position, number, _ = kind.entries[name]
    offset = _word(builder, record.table, position)
    address = builder.gep(record.numbers, [offset])
    return builder.bitcast(address, context.get_data_type(number).as_pointer()), record


@lower_getattr_generic(RecordType)
def _get(context: Any, builder: Any, kind: RecordType, value: Any, name: str) -> Any:
    position, number, axes = kind.entries[name]
    address, record = _place(context, builder, kind, value, name)
    if not axes:
        return context.unpack_value(builder, number, address)
    array_type = kind.entry_type(name)
    array = make_array(array_type)(context, builder)
    size = context.get_abi_sizeof(context.get_data_type(number))
    shape = [_word(builder, record.table, position + 1 + axis) for axis in range(axes)]
    stride, strides = ir.Constant(ir.IntType(64), size), list[Any]()
    for length in reversed(shape):
        strides.insert(0, stride)
        stride = builder.mul(stride, length)
    itemsize = ir.Constant(ir.IntType(64), size)
    populate_array(array, address, shape, strides, itemsize, None)
    return impl_ret_untracked(context, builder, array_type, array._getvalue())


@lower_setattr_generic(RecordType)
def _set(context: Any, builder: Any, signature: Any, arguments: Any, name: str) -> None:
    kind, given = signature.args
    _, number, _ = kind.entries[name]
    address, _ = _place(context, builder, kind, arguments[0], name)
    context.pack_value(builder, number, context.cast(builder, arguments[1], given, number), address)
