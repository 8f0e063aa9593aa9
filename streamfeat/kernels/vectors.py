"""Short vector code that a loop in Python cannot be made to compile to.

Lives here: functions written in LLVM's own terms, each for a line or a block of numbers.
Not here: what the numbers mean (`volume`).

The code names no processor. LLVM finds the instruction: products of pairs and their sum are `vpdpwssd` with
AVX-512 VNNI, `vpmaddwd` with AVX2, `pmaddwd` with SSE2, and plain multiplications elsewhere. All of them
are exact, so the bits are the same everywhere. Floats are summed in an order that is written down.
"""

from typing import Any

from llvmlite import ir
from numba import types

from streamfeat.kernels.assembly import (
    BLOCK,
    I1,
    I16,
    I32,
    I64,
    in_blocks,
    int64,
    load,
    order,
    place,
    product_of_pairs,
    repeat,
    splat,
)
from streamfeat.kernels.compiled import generated

__all__ = [
    "copy_eight",
    "filled_mask",
    "lowest_bit",
    "multiply_tile",
    "prefetch",
    "sum_listed",
    "sum_products",
]

EIGHT, MASK_BITS = 8, 64
"""Numbers that `copy_eight` copies, and that `filled_mask` looks at."""


@generated
def copy_eight(typing: Any, source: Any, start: Any, target: Any, to: Any) -> Any:
    """Copy eight int16 numbers: `target[to : to + 8] = source[start : start + 8]`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, start, target, to = arguments
        kinds = signature.args
        vector = ir.VectorType(I16, EIGHT)
        numbers = load(builder, context.make_array(kinds[0])(context, builder, source), start, vector)
        there = place(builder, context.make_array(kinds[2])(context, builder, target), to, vector)
        builder.store(numbers, there).align = 2
        return context.get_dummy_value()

    return types.void(source, types.int64, target, types.int64), generate


@generated
def filled_mask(typing: Any, values: Any, start: Any) -> Any:
    """Bit `i` tells whether `values[start + i]`, of 64 int16 numbers, is not zero; uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        vector = ir.VectorType(I16, MASK_BITS)
        numbers = load(builder, array, arguments[1], vector)
        filled = builder.icmp_unsigned("!=", numbers, ir.Constant(vector, None))
        return builder.bitcast(filled, I64)

    return types.uint64(values, types.int64), generate


@generated
def lowest_bit(typing: Any, mask: Any) -> Any:
    """Index of the lowest bit that is set; the mask is not zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(I1, 1))

    return types.int64(types.uint64), generate


@generated
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Begin to load an element that is needed soon; what it holds, and whether it exists, does not matter."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        there = builder.bitcast(builder.gep(array.data, [arguments[1]]), ir.IntType(8).as_pointer())
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", [there.type], ir.FunctionType(ir.VoidType(), [there.type, I32, I32, I32])
        )
        read, near, data = (ir.Constant(I32, value) for value in (0, 3, 1))
        builder.call(function, [there, read, near, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@generated
def sum_listed(typing: Any, n: Any, entries: Any, changes: Any, columns: Any, sums: Any) -> Any:
    """Sums of multiples of columns, each block of filters in registers throughout.

    `sums[k] = sum of changes[i] * columns[entries[i], k]` over `n` listed columns. The number of filters is a
    multiple of 32. Sums of 32 bits take two columns at a time: behind an odd list there is one entry more,
    with a change of zero. Sums of 16 bits are modulo 2^16.
    """
    widest, sum_block = (7, _sum_narrow) if sums.dtype == types.int16 else (3, _sum_pairs)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[1:], arguments[1:], strict=True)
        ]
        width = builder.extract_value(arrays[2].shape, 1)
        in_blocks(
            builder,
            width,
            widest,  # vectors whose sums fit into registers
            lambda first, vectors: sum_block(builder, arguments[0], arrays, width, first, vectors),
        )
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
        n, first, filters = arguments[0], arguments[1], arguments[5]
        last, volumes = builder.sub(n, int64(1)), []
        for i in range(TILE):
            volume = builder.add(first, int64(i))
            volumes.append(builder.select(builder.icmp_signed("<", volume, last), volume, last))
        length = builder.extract_value(windows.shape, 1)
        starts = [builder.mul(volume, length) for volume in volumes]
        totals = _multiply(builder, builder.extract_value(packed.shape, 0), windows, starts, packed)
        width = builder.extract_value(projections.shape, 1)
        narrow = kinds[6].dtype == types.int16
        for volume, sums in zip(volumes, totals, strict=True):
            row = builder.zext(builder.load(builder.gep(rows.data, [volume])), I64)
            at = builder.add(builder.mul(row, width), filters)
            for half, total in enumerate(sums):
                to = builder.add(at, int64(half * _HALF))
                stored = _saturated(builder, total) if narrow else total
                builder.store(stored, place(builder, projections, to, stored.type)).align = 2
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, windows, rows, packed, types.int64, projections), generate


def _multiply(builder: Any, pairs: Any, windows: Any, starts: list[Any], packed: Any) -> list[list[Any]]:
    """The loop over pairs of entries: two vectors of sums for each volume, in registers throughout."""
    both, half = ir.VectorType(I16, BLOCK), ir.VectorType(I32, _HALF)

    def add(index: Any, totals: list[Any]) -> list[Any]:
        at, item = builder.mul(index, int64(2 * BLOCK)), builder.shl(index, int64(1))
        columns = [load(builder, packed, builder.add(at, int64(i * BLOCK)), both) for i in range(2)]
        following = []
        for i, start in enumerate(starts):
            factors = load(builder, windows, builder.add(start, item), ir.VectorType(I16, 2))
            factors = builder.shuffle_vector(factors, factors, order([0, 1] * _HALF))
            for total, column in zip(totals[2 * i : 2 * i + 2], columns, strict=True):
                following.append(builder.add(total, product_of_pairs(builder, column, factors)))
        return following

    totals = repeat(builder, pairs, [ir.Constant(half, None)] * (2 * len(starts)), add)
    return [totals[2 * i : 2 * i + 2] for i in range(len(starts))]


_HALF = BLOCK // 2


def _saturated(builder: Any, total: Any) -> Any:
    """Sums in 16 bits, into which they fit.

    Bounded all the same: LLVM would see that no upper half is asked for, and multiply in another, four times
    slower way.
    """
    for sign, bound in (("<", 2**15 - 1), (">", -(2**15))):
        edge = ir.Constant(total.type, [bound] * _HALF)
        total = builder.select(builder.icmp_signed(sign, total, edge), total, edge)
    return builder.trunc(total, ir.VectorType(I16, _HALF))


_LOW, _HIGH = (
    order([k for lane in range(0, BLOCK, 8) for i in range(lane, lane + 4) for k in (at + i, BLOCK + at + i)])
    for at in (0, 4)
)
"""Interleave two columns, the lower and the upper four of every eight filters: one instruction each."""

_FIRST, _SECOND = (
    order([at + 4 * four + i for four in fours for at in (0, _HALF) for i in range(4)])
    for fours in ((0, 1), (2, 3))
)
"""Undo it: the first and the second half of the sums, in the order of the filters."""


def _sum_narrow(builder: Any, n: Any, arrays: list[Any], width: Any, first: Any, vectors: int) -> None:
    """Sum one block of `vectors` times `BLOCK` filters from the filter `first` on, in 16 bits."""
    entries, changes, columns, sums = arrays
    block = ir.VectorType(I16, BLOCK)

    def add(index: Any, totals: list[Any]) -> list[Any]:
        change = splat(builder, builder.load(builder.gep(changes.data, [index])))
        entry = builder.zext(builder.load(builder.gep(entries.data, [index])), I64)
        start = builder.add(builder.mul(entry, width), first)
        places = [builder.add(start, int64(i * BLOCK)) for i in range(vectors)]
        products = [builder.mul(change, load(builder, columns, at, block)) for at in places]
        return [builder.add(*pair) for pair in zip(totals, products, strict=True)]

    totals = repeat(builder, n, [ir.Constant(block, None)] * vectors, add)
    for i, total in enumerate(totals):
        at = builder.add(first, int64(i * BLOCK))
        builder.store(total, place(builder, sums, at, block)).align = 2


def _sum_pairs(builder: Any, n: Any, arrays: list[Any], width: Any, first: Any, vectors: int) -> None:
    """The same in 32 bits, two columns at a time."""
    entries, changes, columns, sums = arrays
    column, half = ir.VectorType(I16, BLOCK), ir.VectorType(I32, _HALF)

    def add(index: Any, totals: list[Any]) -> list[Any]:
        item = builder.shl(index, int64(1))
        factors = load(builder, changes, item, ir.VectorType(I16, 2))
        factors = builder.shuffle_vector(factors, factors, order([0, 1] * _HALF))
        starts = [
            builder.add(builder.mul(builder.zext(builder.load(entry), I64), width), first)
            for entry in (builder.gep(entries.data, [builder.add(item, int64(i))]) for i in range(2))
        ]
        following: list[Any] = []
        for vector in range(vectors):
            at = int64(vector * BLOCK)
            both = [load(builder, columns, builder.add(start, at), column) for start in starts]
            for mixed in (_LOW, _HIGH):
                total, pair = totals[len(following)], builder.shuffle_vector(*both, mixed)
                following.append(builder.add(total, product_of_pairs(builder, pair, factors)))
        return following

    totals = repeat(
        builder,
        builder.lshr(builder.add(n, int64(1)), int64(1)),
        [ir.Constant(half, None)] * (2 * vectors),
        add,
    )
    for vector in range(vectors):
        low, high = totals[2 * vector : 2 * vector + 2]
        for i, straight in enumerate((_FIRST, _SECOND)):
            at = builder.add(first, int64(vector * BLOCK + i * _HALF))
            builder.store(
                builder.shuffle_vector(low, high, straight), place(builder, sums, at, half)
            ).align = 4


_FLOATS = 16
"""Floats in one vector of `sum_products`; two of them are summed side by side."""


@generated
def sum_products(typing: Any, one: Any, start: Any, other: Any, begin: Any, n: Any) -> Any:
    """Sum of `one[start + i] * other[begin + i]` over `n` float32 numbers, a multiple of 32; in this order.

    Lane `j` of 32 sums products `j`, `j + 32`, and so on, each product and each sum rounded. Then the upper
    half of the lanes is added to the lower one, until one is left.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, lanes = signature.args, ir.VectorType(ir.FloatType(), _FLOATS)
        arrays = [context.make_array(kinds[i])(context, builder, arguments[i]) for i in (0, 2)]

        def add(index: Any, totals: list[Any]) -> list[Any]:
            at = builder.mul(index, int64(2 * _FLOATS))
            following = []
            for half, total in enumerate(totals):
                offset = builder.add(at, int64(half * _FLOATS))
                factors = [
                    load(builder, array, builder.add(arguments[first], offset), lanes, align=4)
                    for array, first in zip(arrays, (1, 3), strict=True)
                ]
                following.append(builder.fadd(total, builder.fmul(*factors)))
            return following

        turns = builder.sdiv(arguments[4], int64(2 * _FLOATS))
        left = builder.fadd(*repeat(builder, turns, [ir.Constant(lanes, None)] * 2, add))
        width = _FLOATS
        while width > 1:
            width //= 2
            halves = [order(list(range(at, at + width))) for at in (0, width)]
            left = builder.fadd(*(builder.shuffle_vector(left, left, half) for half in halves))
        return builder.extract_element(left, ir.Constant(I32, 0))

    return types.float32(one, types.int64, other, types.int64, types.int64), generate
