"""Words: rows of 16 values of 4 bytes at addresses, copied, counted and packed as one vector.

numba lacks these steps: they are written in LLVM's language, into the loops that call them.
"""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
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


def _typed_bits(typing_context: Context, address: types.Type) -> tuple[Signature, Lowering]:
    """Return 16 bits: which of 16 words at an address are not zero."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        row = ir.VectorType(ir.IntType(32), BLOCK)
        flags = builder.load(builder.inttoptr(values[0], row.as_pointer()), align=1)
        return builder.bitcast(builder.icmp_unsigned("!=", flags, ir.Constant(row, None)), ir.IntType(BLOCK))

    return types.uint16(types.int64), generate


bits_of: Any = intrinsic(_typed_bits)


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


def _typed_interleave(
    typing_context: Context, x: types.Type, y: types.Type, z: types.Type, target: types.Type
) -> tuple[Signature, Lowering]:
    """Write three rows of 16 words at three addresses as 16 triples to a fourth."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        word = ir.IntType(32)
        row = ir.VectorType(word, BLOCK)
        first, second, third = (
            builder.load(builder.inttoptr(value, row.as_pointer()), align=4) for value in values[:3]
        )
        pairs = builder.shuffle_vector(
            first, second, ir.Constant(ir.VectorType(word, 2 * BLOCK), list(range(2 * BLOCK)))
        )
        padded = builder.shuffle_vector(
            third, third, ir.Constant(ir.VectorType(word, 2 * BLOCK), list(range(2 * BLOCK)))
        )
        for part in range(3):
            places = [divmod(part * BLOCK + lane, 3) for lane in range(BLOCK)]
            order = [lane + axis * BLOCK for lane, axis in places]
            mixed = builder.shuffle_vector(pairs, padded, ir.Constant(row, order))
            address = builder.add(values[3], ir.Constant(ir.IntType(64), 4 * BLOCK * part))
            builder.store(mixed, builder.inttoptr(address, row.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64, types.int64), generate


interleave: Any = intrinsic(_typed_interleave)


def _typed_count(typing_context: Context, bits: types.Type) -> tuple[Signature, Lowering]:
    """Return the number of set bits among 16."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        return builder.zext(builder.ctpop(values[0]), ir.IntType(64))

    return types.int64(types.uint16), generate


count: Any = intrinsic(_typed_count)


def _typed_squeeze(
    typing_context: Context, bits: types.Type, source: types.Type, target: types.Type, size: types.IntegerLiteral
) -> tuple[Signature, Lowering]:
    """Copy those of 16 values at an address whose bit is set, packed, to another address.

    LLVM's compress-store, which numba does not expose: with AVX-512 one instruction instead of sixteen branches.
    """
    word = ir.IntType(8 * size.literal_value)

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value | None:
        row, chosen = ir.VectorType(word, BLOCK), ir.VectorType(ir.IntType(1), BLOCK)
        kind = ir.FunctionType(ir.VoidType(), [row, word.as_pointer(), chosen])
        name = f"llvm.masked.compressstore.v{BLOCK}i{word.width}"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        lanes = builder.load(builder.inttoptr(values[1], row.as_pointer()), align=1)
        target = builder.inttoptr(values[2], word.as_pointer())
        builder.call(function, [lanes, target, builder.bitcast(values[0], chosen)])
        return context.get_dummy_value()

    return types.void(types.uint16, types.int64, types.int64, size), generate


squeeze: Any = intrinsic(prefer_literal=True)(_typed_squeeze)
