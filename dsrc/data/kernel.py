"""The loops of the readers that are compiled; who imports this does without where there is no numba."""

import logging
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

log = logging.getLogger(__name__)

DIGITS = 19
"""So many always fit into 64 bits."""
EXACT = 22
"""Powers of ten up to this one are exact in float64."""
POWERS = 80
"""Powers of ten up to this one and its inverse are known: times 19 digits they stay among the normal float64."""
CELL_M, CELLS = 2.0, 128
"""Boxes are listed by cells of the plane, so many along each axis before they begin anew."""
GROWN_M = 1e-3
"""Boxes reach so far into other cells: more than any rounding."""


def _is_cached() -> bool:
    """Return whether numba has a folder to keep what it compiles: beside this file, or one of the user's own."""
    try:
        njit(cache=True)(_is_cached)
    except RuntimeError:
        log.warning("no folder to keep compiled loops in: each process compiles them; NUMBA_CACHE_DIR names one")
        return False
    return True


_OPTIONS: dict[str, Any] = {"nogil": True, "cache": _is_cached(), "error_model": "numpy"}
_PART: dict[str, Any] = {**_OPTIONS, "forceinline": True}

_u = np.uint64
# An integer with a sign and one without would make a float.
_ONE, _TEN = _u(1), _u(10)
_TENS = np.array([10**k for k in range(9)], np.uint64)


def _typed_zeros(typing_context: Any, word: Any) -> Any:
    """Return how many zero bits a word ends with."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.cttz(values[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), generate


def _typed_head(typing_context: Any, word: Any) -> Any:
    """Return how many zero bits a word that is not 0 begins with."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.ctlz(values[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


def _typed_upper(typing_context: Any, a: Any, b: Any) -> Any:
    """Return the upper 64 bits of a product."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        return builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), generate


_zeros: Any = intrinsic(_typed_zeros)
_head: Any = intrinsic(_typed_head)
_upper: Any = intrinsic(_typed_upper)


@njit(**_PART)
def _is_space(word: Any) -> Any:
    """Return whether the first byte of a word is white space."""
    byte = word & _u(0xFF)
    return byte == _u(32) or (byte >= _u(9) and byte <= _u(13))


@njit(**_PART)
def _digits(word: Any, mantissa: Any) -> Any:
    """Return how many of a word's eight bytes are digits before another comes, and the mantissa with them behind it."""
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


@njit(**_PART)
def _rounded(mantissa: Any, exponent: Any, high: Any, low: Any) -> Any:
    """Return the bits of the float64 next to mantissa x 10^exponent; 0 where 128 bits do not tell.

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


@njit(**_OPTIONS)
def scan(words: Any, end: Any, place: Any, values: Any, bits: Any, done: Any, tens: Any, high: Any, low: Any) -> Any:
    """Read numbers of a text.

    Args:
        words: (B,) uint64 the eight bytes from each byte on.
        end: no number that begins at this byte or later is read.
        place: first byte to look at.
        values: (N,) float64 the numbers.
        bits: the same memory as uint64.
        done: how many of them there are already.
        tens: (23,) float64 powers of ten.
        high: (161,) uint64 upper halves of the 128 bits of 10^-80 to 10^80.
        low: the lower halves.

    Returns:
        The byte to go on at and how many numbers there are: all, or there begins a word that is left to others, or
        the byte is not before `end`.
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
        # No branch: half of the numbers are negative, in no order that a processor could foresee.
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


@njit(**_PART)
def _cell(place: Any) -> Any:
    """Return the number of the cell of a coordinate; those a period apart share it."""
    return np.int64(np.floor(place / CELL_M)) & (CELLS - 1)


@njit(**_OPTIONS)
def pairs_inside(
    points: Any,
    matrix: Any,
    low: Any,
    high: Any,
    margin: Any,
    center: Any,
    reach: Any,
    turn: Any,
    hull: Any,
    pairs: Any,
) -> Any:
    """Find every pair of a point and a box that it lies in.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        matrix: (4, 4) from the points' frame to the boxes'.
        low: (N, 3) least coordinates of the boxes' corners.
        high: (N, 3) greatest ones.
        margin: how far beyond these a point may lie in a box, m.
        center: (N, 3).
        reach: (N, 3) how far from the centre a point may lie in a box, along its own axes.
        turn: (N, 2) cosine and sine of the headings.
        hull: ask whether a point lies between `low` and `high` only.
        pairs: (K, 2) int32 room for rows of points and of boxes.

    Returns:
        How many pairs there are; the first K of them are in `pairs`.
    """
    # A turned box grows by more along the axes: up to the root of 2.
    grown = 1.5 * max(margin, 0.0) + GROWN_M
    start = np.zeros(CELLS * CELLS + 1, np.int64)
    boxes = np.zeros(0, np.int64)
    for filling in (False, True):
        # Once to count the boxes of each cell, once to list them; the starts of the cells are their ends at first.
        for box in range(len(low)):
            x, y = low[box, 0] - grown, low[box, 1] - grown
            columns, rows = (high[box, 0] + grown - x) / CELL_M, (high[box, 1] + grown - y) / CELL_M
            for column in range(min(int(columns) + 2, CELLS)):
                for row in range(min(int(rows) + 2, CELLS)):
                    cell = _cell(x + column * CELL_M) * CELLS + _cell(y + row * CELL_M)
                    if filling:
                        start[cell] -= 1
                        boxes[start[cell]] = box
                    else:
                        start[cell] += 1
        if not filling:
            for cell in range(CELLS * CELLS):
                start[cell + 1] += start[cell]
            boxes = np.zeros(start[-1], np.int64)
    found = 0
    for point in range(len(points)):
        a, b, c = np.float64(points[point, 0]), np.float64(points[point, 1]), np.float64(points[point, 2])
        x = matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c + matrix[0, 3]
        y = matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c + matrix[1, 3]
        cell = _cell(x) * CELLS + _cell(y)
        if start[cell] == start[cell + 1]:
            continue
        z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
        for k in range(start[cell], start[cell + 1]):
            box = boxes[k]
            if hull:
                inside = low[box, 0] <= x <= high[box, 0] and low[box, 1] <= y <= high[box, 1]
                inside = inside and low[box, 2] <= z <= high[box, 2]
            else:
                dx, dy, dz = x - center[box, 0], y - center[box, 1], z - center[box, 2]
                along = abs(turn[box, 0] * dx + turn[box, 1] * dy)
                across = abs(turn[box, 0] * dy - turn[box, 1] * dx)
                inside = along <= reach[box, 0] and across <= reach[box, 1] and abs(dz) <= reach[box, 2]
            if inside:
                if found < len(pairs):
                    pairs[found, 0] = point
                    pairs[found, 1] = box
                found += 1
    return found


@njit(**_OPTIONS)
def sort_voxels(points: Any, low: Any, size: Any, shape: Any, max_points: Any, max_voxels: Any) -> Any:
    """Sort points into voxels, first come, first served; see `dsrc.ops.pillars.voxelise`.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        low: (3,) float32 where the range begins.
        size: (3,) float32 sides of a voxel.
        shape: (3,) int64 voxels along x, y and z.
        max_points: cap per voxel.
        max_voxels: cap on voxels.

    Returns:
        (K,) int64 the points that are kept, voxel by voxel; (V,) int64 the voxels' flat cells in z, y, x order and
        (V,) int64 how many points each keeps.
    """
    opened = 0
    voxel_at = np.full(shape[0] * shape[1] * shape[2], -1, np.int32)
    cells = np.zeros(min(len(points), max_voxels), np.int64)
    count = np.zeros(len(cells), np.int64)
    voxel_of = np.full(len(points), -1, np.int32)
    for point in range(len(points)):
        x = np.floor((points[point, 0] - low[0]) / size[0])
        y = np.floor((points[point, 1] - low[1]) / size[1])
        z = np.floor((points[point, 2] - low[2]) / size[2])
        if not (x >= 0 and x < shape[0] and y >= 0 and y < shape[1] and z >= 0 and z < shape[2]):
            continue
        cell = (np.int64(z) * shape[1] + np.int64(y)) * shape[0] + np.int64(x)
        voxel = voxel_at[cell]
        if voxel < 0:
            if opened == max_voxels:
                continue
            voxel = np.int32(opened)
            voxel_at[cell] = voxel
            cells[opened] = cell
            opened += 1
        if count[voxel] < max_points:
            voxel_of[point] = voxel
            count[voxel] += 1
    place = np.cumsum(count[:opened]) - count[:opened]
    order = np.zeros(count.sum(), np.int64)
    for point in range(len(points)):
        voxel = voxel_of[point]
        if voxel >= 0:
            order[place[voxel]] = point
            place[voxel] += 1
    return order, cells[:opened], count[:opened]


@njit(**_OPTIONS)
def sum_cells(points: Any, low: Any, size: Any, shape: Any) -> Any:
    """Add up the points of each cell; those beyond the range are in its outermost cells.

    Args:
        points: (P, 3 or more) float32 x, y, z.
        low: (3,) float64 where the range begins.
        size: (3,) float64 sides of a cell.
        shape: (3,) int64 cells along x, y and z.

    Returns:
        (V,) int64 flat cells in z, y, x order with a point, ascending; (V,) int64 how many each has and (V, 3) float64
        their sums.
    """
    found = 0
    row_of = np.full(shape[0] * shape[1] * shape[2], -1, np.int32)
    # Sums of a row for each cell with points stay in a processor's cache, those of all cells do not.
    count = np.zeros(min(len(points), len(row_of)), np.int64)
    sums = np.zeros((len(count), 3))
    for point in range(len(points)):
        cell = 0
        for axis in (2, 1, 0):
            place = (np.float64(points[point, axis]) - low[axis]) / size[axis]
            # A comparison with NaN is false: a point that is nowhere is in the first cell, not outside of the arrays.
            place = place if place > 0.0 else 0.0
            cell = cell * shape[axis] + np.int64(min(place, np.float64(shape[axis] - 1)))
        row = row_of[cell]
        if row < 0:
            row = np.int32(found)
            row_of[cell] = row
            found += 1
        count[row] += 1
        for axis in range(3):
            sums[row, axis] += np.float64(points[point, axis])
    cells = np.flatnonzero(row_of >= 0)
    rows = row_of[cells]
    return cells, count[rows], sums[rows]
