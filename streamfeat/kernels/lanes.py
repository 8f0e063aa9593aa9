"""Vector code of the narrow state: lanes of 16 bits, of which a register holds twice as many.

Lives here: two functions written in LLVM's own terms, for blocks of 32 filters of one or several volumes.
Not here: what the numbers mean and who calls them (`narrow`), vector code that any state uses (`vectors`).

All of it is integer arithmetic of one instruction each on a processor with vectors of 16-bit numbers, from
SSE2 on, and exact: the bits are the same everywhere.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from streamfeat.kernels.assembly import (
    BLOCK,
    I16,
    I32,
    int64,
    load,
    order,
    place,
    product_of_pairs,
    repeat,
    splat,
)
from streamfeat.kernels.compiled import generated

__all__ = ["move_group", "pool_row"]

_LANES, _HALF = ir.VectorType(I16, BLOCK), ir.VectorType(I32, BLOCK // 2)

_SIGN = ir.Constant(_LANES, [-(2**15)] * BLOCK)
"""Turns a signed number into an unsigned one that is 2^15 larger."""

_BOTH_HALVES = order([k for i in range(BLOCK // 2) for k in (i, BLOCK // 2 + i)])
"""Sums of even lanes and sums of odd lanes, in the order of the filters."""


def _arrays(context: Any, builder: Any, signature: Any, arguments: Any, indices: range) -> list[Any]:
    return [context.make_array(signature.args[i])(context, builder, arguments[i]) for i in indices]


def _difference(builder: Any, number: Any, least: Any) -> Any:
    """`max(number - least, 0)` of unsigned numbers."""
    name, kind = f"llvm.usub.sat.v{BLOCK}i16", ir.FunctionType(_LANES, [_LANES, _LANES])
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, [number, least])


def _parts(builder: Any, projection: Any, factors: Any, bounds: tuple[Any, Any]) -> tuple[Any, Any]:
    """Positive and negative part of the codes of a block; see `narrow.narrow_code`."""
    shift, factor = factors
    wide = ir.VectorType(I32, BLOCK)
    numbers, factor = (builder.sext(x, wide) for x in (builder.shl(projection, shift), factor))
    high = builder.ashr(builder.mul(numbers, factor), ir.Constant(wide, [16] * BLOCK))
    level = builder.xor(builder.trunc(high, _LANES), _SIGN)
    upper, lower = bounds
    return _difference(builder, level, upper), _difference(builder, lower, level)


def _factors(builder: Any, packed: Any, at: int) -> tuple[Any, Any]:
    """Shift and factor of a volume, out of four numbers of 16 bits that are packed into 64."""
    shift, factor = (builder.trunc(builder.lshr(packed, int64(at + 16 * i)), I16) for i in range(2))
    return splat(builder, shift), splat(builder, factor)


@generated
def pool_row(
    typing: Any, sign: Any, packed: Any, projection: Any, upper: Any, lower: Any, pooled: Any
) -> Any:
    """Add the code of one volume to the sums of its cell (`sign` 1) or take it away (-1).

    Args are those of `narrow.pool_narrow`; the number of filters is a multiple of 32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sign, packed = arguments[:2]
        projection, upper, lower, pooled = _arrays(context, builder, signature, arguments, range(2, 6))
        width, wide = builder.extract_value(projection.shape, 0), ir.VectorType(I32, BLOCK)
        factors = _factors(builder, packed, 0)
        turn = splat(builder, builder.trunc(builder.ashr(sign, int64(63)), I16))

        def add(index: Any, _: list[Any]) -> list[Any]:
            first = builder.mul(index, int64(BLOCK))
            bounds = (load(builder, upper, first, _LANES), load(builder, lower, first, _LANES))
            parts = _parts(builder, load(builder, projection, first, _LANES), factors, bounds)
            for part, at in zip(parts, (first, builder.add(width, first)), strict=True):
                signed = builder.sext(builder.sub(builder.xor(part, turn), turn), wide)
                total = builder.add(load(builder, pooled, at, wide, 4), signed)
                builder.store(total, place(builder, pooled, at, wide)).align = 4
            return []

        repeat(builder, builder.udiv(width, int64(BLOCK)), [], add)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, projection, upper, lower, pooled), generate


@generated
def move_group(
    typing: Any,
    n: Any,
    sign: Any,
    queue: Any,
    columns: Any,
    projections: Any,
    upper: Any,
    lower: Any,
    pooled: Any,
) -> Any:
    """Volumes of one cell follow a column each: projections, codes, and the sums of the cell.

    Args are those of `narrow.move_queued`; the number of filters is a multiple of 32. What the codes of a
    block change by is summed in registers over all volumes, even and odd lanes apart, by sums of pairs of
    which one is multiplied by zero.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        n, sign = arguments[:2]
        queue, columns, projections, upper, lower, pooled = _arrays(
            context, builder, signature, arguments, range(2, 8)
        )
        width = builder.extract_value(upper.shape, 0)
        even, odd = (_lanes_of(builder, pair) for pair in (1, 1 << 16))

        def move(first: Any, join: Any) -> list[Any]:
            bounds = (load(builder, upper, first, _LANES), load(builder, lower, first, _LANES))

            def follow(index: Any, totals: list[Any]) -> list[Any]:
                row = builder.mul(index, int64(3))
                column, projection, packed = (
                    builder.load(builder.gep(queue.data, [builder.add(row, int64(i))])) for i in range(3)
                )
                column, projection = builder.add(column, first), builder.add(projection, first)
                before = load(builder, projections, projection, _LANES)
                after = join(before, load(builder, columns, column, _LANES))
                builder.store(after, place(builder, projections, projection, _LANES)).align = 2
                old = _parts(builder, before, _factors(builder, packed, 0), bounds)
                new = _parts(builder, after, _factors(builder, packed, 32), bounds)
                changes = [builder.sub(mine, its) for mine, its in zip(new, old, strict=True)]
                return [
                    builder.add(total, product_of_pairs(builder, change, lanes))
                    for total, change, lanes in zip(
                        totals, [c for c in changes for _ in range(2)], [even, odd] * 2, strict=True
                    )
                ]

            return repeat(builder, n, [ir.Constant(_HALF, None)] * 4, follow)

        def block(index: Any, _: list[Any]) -> list[Any]:
            first = builder.mul(index, int64(BLOCK))
            slots = [cgutils.alloca_once(builder, _HALF) for _ in range(4)]  # type: ignore[no-untyped-call]
            with builder.if_else(builder.icmp_signed(">=", sign, int64(0))) as ways:
                for way, join in zip(ways, (builder.add, builder.sub), strict=True):
                    with way:
                        for slot, total in zip(slots, move(first, join), strict=True):
                            builder.store(total, slot)
            totals = [builder.load(slot) for slot in slots]
            for i, at in enumerate((first, builder.add(width, first))):
                change = builder.shuffle_vector(*totals[2 * i : 2 * i + 2], _BOTH_HALVES)
                total = builder.add(load(builder, pooled, at, change.type, 4), change)
                builder.store(total, place(builder, pooled, at, change.type)).align = 4
            return []

        repeat(builder, builder.udiv(width, int64(BLOCK)), [], block)
        return context.get_dummy_value()

    kinds = (types.int64, types.int64, queue, columns, projections, upper, lower, pooled)
    return types.void(*kinds), generate


def _lanes_of(builder: Any, pair: int) -> Any:
    """A pair of 16-bit factors in all lanes, hidden from LLVM: it goes a longer way with zeros and ones."""
    kind = ir.FunctionType(I32, [I32])
    hidden = builder.asm(kind, "", "=r,0", [ir.Constant(I32, pair)], side_effect=False)
    factors = builder.bitcast(hidden, ir.VectorType(I16, 2))
    return builder.shuffle_vector(factors, factors, order([0, 1] * (BLOCK // 2)))
