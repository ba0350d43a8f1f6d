"""Compiled loop of `decimals`: eight digits at a time, products of 128 bits."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context, Signature
from numba.extending import intrinsic
from numpy.typing import NDArray

from sensors.compiled import compiled

DIGITS = 19
"""Most digits that always fit into 64 bits."""
EXACT = 22
"""Largest power of ten that is exact in float64."""
POWERS = 80
"""Largest power of ten in the table, and of its inverse: times 19 digits they stay among the normal float64."""

Lowering = Callable[[BaseContext, ir.IRBuilder, Signature, Sequence[ir.Value]], ir.Value]

_u = np.uint64
# An integer with a sign and one without would make a float.
_ONE, _TEN = _u(1), _u(10)
_TENS = np.array([10**k for k in range(9)], np.uint64)


def _typed_zeros(typing_context: Context, word: types.Type) -> tuple[Signature, Lowering]:
    """Return the number of trailing zero bits of a word."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value:
        return builder.cttz(values[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), generate


def _typed_head(typing_context: Context, word: types.Type) -> tuple[Signature, Lowering]:
    """Return the number of leading zero bits of a word other than 0."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value:
        return builder.ctlz(values[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


def _typed_upper(typing_context: Context, a: types.Type, b: types.Type) -> tuple[Signature, Lowering]:
    """Return the upper 64 bits of a product."""

    def generate(
        context: BaseContext, builder: ir.IRBuilder, signature: Signature, values: Sequence[ir.Value]
    ) -> ir.Value:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        return builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), generate


_zeros: Any = intrinsic(_typed_zeros)
_head: Any = intrinsic(_typed_head)
_upper: Any = intrinsic(_typed_upper)


@compiled(forceinline=True)
def _is_space(word: np.uint64) -> np.bool_:
    """Return whether the first byte of a word is white space."""
    byte = word & _u(0xFF)
    return byte == _u(32) or (byte >= _u(9) and byte <= _u(13))


@compiled(forceinline=True)
def _digits(word: np.uint64, mantissa: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Return the number of leading digits among a word's eight bytes, and the mantissa with them appended."""
    word ^= _u(0x3030303030303030)
    other = ((word + _u(0x7676767676767676)) | word) & _u(0x8080808080808080)
    count = _u(8)
    if other != _u(0):
        count = _zeros(other) >> _u(3)
        # Twice, as a shift by all 64 bits would be none.
        word <<= (_u(8) - count) << _u(2)
        word <<= (_u(8) - count) << _u(2)
    word = word * _TEN + (word >> _u(8))
    pair = _u(0x000000FF000000FF)
    value = (word & pair) * _u(0x000F424000000064) + ((word >> _u(16)) & pair) * _u(0x0000271000000001)
    return count, mantissa * _TENS[count] + (value >> _u(32))


@compiled(forceinline=True)
def _rounded(mantissa: np.uint64, exponent: np.int64, high: NDArray[np.uint64], low: NDArray[np.uint64]) -> np.uint64:
    """Return the bits of the float64 next to mantissa x 10^exponent; 0 where 128 bits leave it open.

    The power is rounded down: the product lies between the one computed and that with one more of the last bit.
    """
    shift = _head(mantissa)
    mantissa <<= shift
    place = _u(exponent + POWERS)
    upper, lower = _upper(mantissa, high[place]), mantissa * high[place]
    tail = _u(0x1FF)
    if upper & tail == tail and lower + mantissa < mantissa:
        more, least = _upper(mantissa, low[place]), mantissa * low[place]
        lower += more
        if lower < more:
            upper += _ONE
        if upper & tail == tail and lower + _ONE == _u(0) and least + mantissa < mantissa:
            return _u(0)
    top = upper >> _u(63)
    bits = upper >> (top + _u(9))
    if lower == _u(0) and upper & tail == _u(0) and bits & _u(3) == _ONE:
        return _u(0)
    # 217706 / 2^16 is the logarithm of 10 to the base 2, near enough for these exponents.
    power = _u(((217706 * exponent) >> 16) + 64 + 1023) - shift - (_ONE ^ top)
    bits = (bits + (bits & _ONE)) >> _ONE
    if bits >> _u(53):
        bits >>= _ONE
        power += _ONE
    return (power << _u(52)) | (bits & _u(2**52 - 1))


@compiled()
def scan(
    words: NDArray[np.uint64],
    end: int,
    place: int,
    values: NDArray[np.float64],
    bits: NDArray[np.uint64],
    done: int,
    tens: NDArray[np.float64],
    high: NDArray[np.uint64],
    low: NDArray[np.uint64],
) -> tuple[np.uint64, int]:
    """Read numbers of a text.

    Args:
        words: (B,) uint64 the eight bytes from each byte on.
        end: numbers that begin at this byte or later are left.
        place: first byte to read.
        values: (N,) float64 the numbers.
        bits: the same memory as uint64.
        done: number of values already read.
        tens: (23,) float64 powers of ten.
        high: (161,) uint64 upper halves of the 128 bits of 10^-80 to 10^80.

    Returns:
        The next byte and the number of values: all of them, or the byte begins a word for a slower reader or has
        reached `end`.
    """
    i, stop, byte = _u(place), _u(end), _u(0xFF)
    while True:
        while i < stop:
            if not _is_space(words[i]):
                break
            i += _ONE
        if i >= stop or done == len(values):
            return i, done
        start = i
        c = words[i] & byte
        # No branch: half of the numbers are negative, in no order that a processor could predict.
        sign = _u(c == _u(45))
        i += sign | _u(c == _u(43))
        if words[i] & _u(0xDFDFDF) == _u(0x4E414E) and _is_space(words[i + _u(3)]):
            values[done] = np.nan
            done += 1
            i += _u(3)
            continue
        mantissa, digits, exponent = _u(0), _u(0), np.int64(0)
        count = _u(8)
        while count == _u(8) and digits <= _u(DIGITS):
            count, mantissa = _digits(words[i], mantissa)
            i += count
            digits += count
        if words[i] & byte == _u(46):
            i += _ONE
            whole = digits
            count = _u(8)
            while count == _u(8) and digits <= _u(DIGITS):
                count, mantissa = _digits(words[i], mantissa)
                i += count
                digits += count
            exponent = -np.int64(digits - whole)
        good = digits > _u(0) and digits <= _u(DIGITS)
        word = words[i]
        if word & _u(0xDF) == _u(69):
            word >>= _u(8)
            i += _ONE
            c = word & byte
            if c == _u(45) or c == _u(43):
                word >>= _u(8)
                i += _ONE
            count, power = _digits(word & _u(0xFFFFFFFF), _u(0))
            i += count
            good &= count > _u(0)
            exponent += -np.int64(power) if c == _u(45) else np.int64(power)
            word = words[i]
        if not (good and _is_space(word)) or exponent < -POWERS or exponent > POWERS:
            return start, done
        if mantissa < _u(2**53) and exponent >= -EXACT and exponent <= EXACT:
            value = np.float64(mantissa)
            values[done] = value / tens[-exponent] if exponent < 0 else value * tens[exponent]
        elif mantissa == _u(0):
            bits[done] = _u(0)
        else:
            bits[done] = _rounded(mantissa, exponent, high, low)
            if bits[done] == _u(0):
                return start, done
        bits[done] |= sign << _u(63)
        done += 1
