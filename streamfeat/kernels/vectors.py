"""Short vector code that a loop in Python cannot be made to compile to.

Lives here: functions written in LLVM's own terms, each for a line or a block of int16 numbers.
Not here: what the numbers mean (`volume`).

The code names no processor. LLVM finds the instruction: products of pairs and their sum are `vpdpwssd` with
AVX-512 VNNI, `vpmaddwd` with AVX2, `pmaddwd` with SSE2, and plain multiplications elsewhere. All of them
are exact, so the bits are the same everywhere.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from streamfeat.kernels.compiled import generated

__all__ = ["copy_eight", "filled_mask", "lowest_bit", "multiply_tile", "prefetch", "sum_pairs"]

EIGHT, MASK_BITS = 8, 64
"""Numbers that `copy_eight` copies, and that `filled_mask` looks at."""

BLOCK, WIDEST = 32, 3
"""Filters in one vector of `sum_pairs`, and vectors in a block: their sums have to fit into registers."""

_I1, _I16, _I32, _I64 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)


def _int64(value: int) -> ir.Constant:
    return ir.Constant(_I64, value)


def _order(indices: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(_I32, len(indices)), indices)


def _place(builder: Any, array: Any, index: Any, kind: Any) -> Any:
    """Pointer to a vector that starts at an element of an array."""
    return builder.bitcast(builder.gep(array.data, [index]), kind.as_pointer())


def _load(builder: Any, array: Any, index: Any, kind: Any, align: int = 2) -> Any:
    loaded = builder.load(_place(builder, array, index, kind))
    loaded.align = align
    return loaded


@generated
def copy_eight(typing: Any, source: Any, start: Any, target: Any, to: Any) -> Any:
    """Copy eight int16 numbers: `target[to : to + 8] = source[start : start + 8]`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, start, target, to = arguments
        kinds = signature.args
        vector = ir.VectorType(_I16, EIGHT)
        numbers = _load(builder, context.make_array(kinds[0])(context, builder, source), start, vector)
        place = _place(builder, context.make_array(kinds[2])(context, builder, target), to, vector)
        builder.store(numbers, place).align = 2
        return context.get_dummy_value()

    return types.void(source, types.int64, target, types.int64), generate


@generated
def filled_mask(typing: Any, values: Any, start: Any) -> Any:
    """Bit `i` tells whether `values[start + i]`, of 64 int16 numbers, is not zero; uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        vector = ir.VectorType(_I16, MASK_BITS)
        numbers = _load(builder, array, arguments[1], vector)
        filled = builder.icmp_unsigned("!=", numbers, ir.Constant(vector, None))
        return builder.bitcast(filled, _I64)

    return types.uint64(values, types.int64), generate


@generated
def lowest_bit(typing: Any, mask: Any) -> Any:
    """Index of the lowest bit that is set; the mask is not zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(_I1, 1))

    return types.int64(types.uint64), generate


@generated
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Begin to load an element that is needed soon; what it holds, and whether it exists, does not matter."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.bitcast(builder.gep(array.data, [arguments[1]]), ir.IntType(8).as_pointer())
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", [place.type], ir.FunctionType(ir.VoidType(), [place.type, _I32, _I32, _I32])
        )
        read, near, data = (ir.Constant(_I32, value) for value in (0, 3, 1))
        builder.call(function, [place, read, near, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@generated
def sum_pairs(typing: Any, pairs: Any, entries: Any, changes: Any, columns: Any, sums: Any) -> Any:
    """Sums of multiples of columns, two columns at a time, each block of filters in registers throughout.

    `sums[k] = sum of changes[i] * columns[entries[i], k]` over `2 * pairs` listed columns. The number of
    filters is a multiple of 32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args[1:]
        arrays = [
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(kinds, arguments[1:], strict=True)
        ]
        width = builder.extract_value(arrays[2].shape, 1)
        # As few blocks as there can be, of nearly the same width: a narrow one would wait for its sums.
        vectors = builder.udiv(width, _int64(BLOCK))
        blocks = builder.udiv(builder.add(vectors, _int64(WIDEST - 1)), _int64(WIDEST))
        narrow, wider = builder.udiv(vectors, blocks), builder.urem(vectors, blocks)
        start = cgutils.alloca_once_value(builder, _int64(0))  # type: ignore[no-untyped-call]
        with cgutils.for_range(builder, blocks) as loop:
            more = builder.zext(builder.icmp_unsigned("<", loop.index, wider), _I64)
            size, first = builder.add(narrow, more), builder.load(start)
            for n in range(1, WIDEST + 1):
                with builder.if_then(builder.icmp_unsigned("==", size, _int64(n))):
                    _sum_block(builder, arguments[0], arrays, width, first, n)
            builder.store(builder.add(first, builder.mul(size, _int64(BLOCK))), start)
        return context.get_dummy_value()

    return types.void(types.int64, entries, changes, columns, sums), generate


TILE = 6
"""Volumes that `multiply_tile` works on at once: their sums and a pair of columns fit into 32 registers."""


@generated
def multiply_tile(
    typing: Any, n: Any, first: Any, windows: Any, rows: Any, packed: Any, filter: Any, projections: Any
) -> Any:
    """Projections of six volumes on 32 filters, from all of their entries.

    `projections[rows[v], filter + k] = sum over i of windows[v, i] * columns[i, filter + k]` for `v` from
    `first` on; beyond `n` it is the last volume again. `packed` holds the columns of these filters in pairs,
    `(pairs, 64)`: of each filter both numbers side by side.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args
        windows, rows, packed, projections = (
            context.make_array(kinds[i])(context, builder, arguments[i]) for i in (2, 3, 4, 6)
        )
        n, first, place = arguments[0], arguments[1], arguments[5]
        last, volumes = builder.sub(n, _int64(1)), []
        for i in range(TILE):
            volume = builder.add(first, _int64(i))
            volumes.append(builder.select(builder.icmp_signed("<", volume, last), volume, last))
        length = builder.extract_value(windows.shape, 1)
        starts = [builder.mul(volume, length) for volume in volumes]
        totals = _multiply(builder, builder.extract_value(packed.shape, 0), windows, starts, packed)
        width = builder.extract_value(projections.shape, 1)
        narrow = kinds[6].dtype == types.int16
        for volume, sums in zip(volumes, totals, strict=True):
            row = builder.zext(builder.load(builder.gep(rows.data, [volume])), _I64)
            at = builder.add(builder.mul(row, width), place)
            for half, total in enumerate(sums):
                to = builder.add(at, _int64(half * _HALF))
                stored = builder.trunc(total, ir.VectorType(_I16, _HALF)) if narrow else total
                builder.store(stored, _place(builder, projections, to, stored.type)).align = 2
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, windows, rows, packed, types.int64, projections), generate


def _multiply(builder: Any, pairs: Any, windows: Any, starts: list[Any], packed: Any) -> list[list[Any]]:
    """The loop over pairs of entries: two vectors of sums for each volume, in registers throughout."""
    both, half = ir.VectorType(_I16, BLOCK), ir.VectorType(_I32, _HALF)
    before = builder.block
    head, body, done = (builder.append_basic_block(name) for name in ("entries", "entry", "multiplied"))
    builder.branch(head)
    builder.position_at_end(head)
    index = builder.phi(_I64)
    totals = [[builder.phi(half) for _ in range(2)] for _ in starts]
    index.add_incoming(_int64(0), before)
    for sums in totals:
        for total in sums:
            total.add_incoming(ir.Constant(half, None), before)
    builder.cbranch(builder.icmp_unsigned("<", index, pairs), body, done)

    builder.position_at_end(body)
    at = builder.mul(index, _int64(2 * BLOCK))
    columns = [_load(builder, packed, builder.add(at, _int64(i * BLOCK)), both) for i in range(2)]
    item = builder.shl(index, _int64(1))
    for start, sums in zip(starts, totals, strict=True):
        factors = _load(builder, windows, builder.add(start, item), ir.VectorType(_I16, 2))
        factors = builder.shuffle_vector(factors, factors, _order([0, 1] * _HALF))
        for total, column in zip(sums, columns, strict=True):
            total.add_incoming(builder.add(total, _product_of_pairs(builder, column, factors)), body)
    index.add_incoming(builder.add(index, _int64(1)), body)
    builder.branch(head)
    builder.position_at_end(done)
    return totals


_HALF = BLOCK // 2

_LOW, _HIGH = (
    _order(
        [k for lane in range(0, BLOCK, 8) for i in range(lane, lane + 4) for k in (at + i, BLOCK + at + i)]
    )
    for at in (0, 4)
)
"""Interleave two columns, the lower and the upper four of every eight filters: one instruction each."""

_FIRST, _SECOND = (
    _order([at + 4 * four + i for four in fours for at in (0, _HALF) for i in range(4)])
    for fours in ((0, 1), (2, 3))
)
"""Undo it: the first and the second half of the sums, in the order of the filters."""


def _sum_block(builder: Any, pairs: Any, arrays: list[Any], width: Any, first: Any, vectors: int) -> None:
    """Sum one block of `vectors` times `BLOCK` filters from the filter `first` on."""
    entries, changes, columns, sums = arrays
    column, half = ir.VectorType(_I16, BLOCK), ir.VectorType(_I32, _HALF)
    before = builder.block
    head, body, done = (builder.append_basic_block(name) for name in ("pairs", "pair", "summed"))
    builder.branch(head)
    builder.position_at_end(head)
    index, *totals = (builder.phi(kind) for kind in (_I64, *[half] * (2 * vectors)))
    for phi in (index, *totals):
        phi.add_incoming(ir.Constant(phi.type, None if phi.type is half else 0), before)
    builder.cbranch(builder.icmp_unsigned("<", index, pairs), body, done)

    builder.position_at_end(body)
    item = builder.shl(index, _int64(1))
    factors = _load(builder, changes, item, ir.VectorType(_I16, 2))
    factors = builder.shuffle_vector(factors, factors, _order([0, 1] * _HALF))
    starts = [
        builder.add(builder.mul(builder.zext(builder.load(place), _I64), width), first)
        for place in (builder.gep(entries.data, [builder.add(item, _int64(i))]) for i in range(2))
    ]
    following: list[Any] = []
    for vector in range(vectors):
        at = _int64(vector * BLOCK)
        both = [_load(builder, columns, builder.add(start, at), column) for start in starts]
        for order in (_LOW, _HIGH):
            total = totals[len(following)]
            pair = builder.shuffle_vector(*both, order)
            following.append(builder.add(total, _product_of_pairs(builder, pair, factors)))
    index.add_incoming(builder.add(index, _int64(1)), body)
    for total, value in zip(totals, following, strict=True):
        total.add_incoming(value, body)
    builder.branch(head)

    builder.position_at_end(done)
    for vector in range(vectors):
        low, high = totals[2 * vector : 2 * vector + 2]
        for i, order in enumerate((_FIRST, _SECOND)):
            at = builder.add(first, _int64(vector * BLOCK + i * _HALF))
            builder.store(builder.shuffle_vector(low, high, order), _place(builder, sums, at, half)).align = 4


def _product_of_pairs(builder: Any, numbers: Any, factors: Any) -> Any:
    """`numbers[2 k] * factors[2 k] + numbers[2 k + 1] * factors[2 k + 1]`, written so that LLVM knows it."""
    wide = ir.VectorType(_I32, BLOCK)
    products = builder.mul(builder.sext(numbers, wide), builder.sext(factors, wide))
    even, odd = (builder.shuffle_vector(products, products, _order(list(range(i, BLOCK, 2)))) for i in (0, 1))
    return builder.add(even, odd)
