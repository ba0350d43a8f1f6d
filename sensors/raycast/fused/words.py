"""Words: C functions called, and rows of 16 values of 4 bytes copied as one vector, by address.

numba lacks these steps: they are written in LLVM's language, into the loops that call them.
"""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context, Signature
from numba.extending import intrinsic

from sensors.optics.beams import BLOCK

Lowering = Callable[[BaseContext, ir.IRBuilder, Signature, Sequence[ir.Value]], ir.Value | None]


def _typed_call(typing_context: Context, address: types.Type, arguments: types.UniTuple) -> tuple[Signature, Lowering]:
    """Call the C function at an address with a tuple of integers or pointers; its result is dropped.

    numba's own ctypes support bakes addresses into the code, which then cannot be cached on disk.
    """

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        word = ir.IntType(64)
        count = len(signature.args[1])
        function = ir.FunctionType(ir.VoidType(), [word] * count)
        target = builder.inttoptr(values[0], function.as_pointer())
        builder.call(target, [builder.extract_value(values[1], i) for i in range(count)])
        return context.get_dummy_value()

    return types.void(types.int64, types.UniTuple(types.int64, len(arguments))), generate


call: Any = intrinsic(_typed_call)


def _typed_copy(typing_context: Context, source: types.Type, target: types.Type) -> tuple[Signature, Lowering]:
    """Copy 16 words from one address to another, as one vector."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        row = ir.VectorType(ir.IntType(32), BLOCK).as_pointer()
        lanes = builder.load(builder.inttoptr(values[0], row), align=4)
        builder.store(lanes, builder.inttoptr(values[1], row), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


copy_row: Any = intrinsic(_typed_copy)
