"""What vector code is put together from, in LLVM's own terms.

Lives here: loading vectors from arrays, loops whose values stay in registers, sums of products of pairs.
Not here: functions that kernels call (`vectors`, `lanes`).
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils

__all__ = [
    "BLOCK",
    "I1",
    "I16",
    "I32",
    "I64",
    "in_blocks",
    "int64",
    "load",
    "order",
    "place",
    "product_of_pairs",
    "repeat",
    "splat",
]

BLOCK = 32
"""Filters that vector code works on at once; what a width is a multiple of."""

I1, I16, I32, I64 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)


def int64(value: int) -> ir.Constant:
    """A constant."""
    return ir.Constant(I64, value)


def order(indices: list[int]) -> ir.Constant:
    """Indices for a shuffle of vectors."""
    return ir.Constant(ir.VectorType(I32, len(indices)), indices)


def place(builder: Any, array: Any, index: Any, kind: Any) -> Any:
    """Pointer to a vector that starts at an element of an array."""
    return builder.bitcast(builder.gep(array.data, [index]), kind.as_pointer())


def load(builder: Any, array: Any, index: Any, kind: Any, align: int = 2) -> Any:
    """A vector that starts at an element of an array."""
    loaded = builder.load(place(builder, array, index, kind))
    loaded.align = align
    return loaded


def splat(builder: Any, value: Any) -> Any:
    """A block of equal numbers."""
    none = ir.Constant(ir.VectorType(value.type, BLOCK), ir.Undefined)
    first = builder.insert_element(none, value, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, none, order([0] * BLOCK))


def repeat(
    builder: Any, stop: Any, start: list[Any], body: Callable[[Any, list[Any]], list[Any]]
) -> list[Any]:
    """`values = body(index, values)` for each index below `stop`; they stay in registers."""
    before = builder.block
    head, inside, done = (builder.append_basic_block(name) for name in ("head", "body", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    index, *values = (builder.phi(value.type) for value in (int64(0), *start))
    for phi, value in zip((index, *values), (int64(0), *start), strict=True):
        phi.add_incoming(value, before)
    builder.cbranch(builder.icmp_signed("<", index, stop), inside, done)
    builder.position_at_end(inside)
    following = body(index, values)
    for phi, value in zip((index, *values), (builder.add(index, int64(1)), *following), strict=True):
        phi.add_incoming(value, builder.block)
    builder.branch(head)
    builder.position_at_end(done)
    return values


def in_blocks(builder: Any, width: Any, widest: int, body: Callable[[Any, int], None]) -> None:
    """`body(first, vectors)` for blocks of at most so many vectors, from the filter `first` on.

    There are as few blocks as there can be, of nearly the same width: a small one would wait for its sums.
    """
    vectors = builder.udiv(width, int64(BLOCK))
    blocks = builder.udiv(builder.add(vectors, int64(widest - 1)), int64(widest))
    least, larger = builder.udiv(vectors, blocks), builder.urem(vectors, blocks)
    start = cgutils.alloca_once_value(builder, int64(0))  # type: ignore[no-untyped-call]
    with cgutils.for_range(builder, blocks) as loop:
        more = builder.zext(builder.icmp_unsigned("<", loop.index, larger), I64)
        size, first = builder.add(least, more), builder.load(start)
        for n in range(1, widest + 1):
            with builder.if_then(builder.icmp_unsigned("==", size, int64(n))):
                body(first, n)
        builder.store(builder.add(first, builder.mul(size, int64(BLOCK))), start)


def product_of_pairs(builder: Any, numbers: Any, factors: Any) -> Any:
    """`numbers[2 k] * factors[2 k] + numbers[2 k + 1] * factors[2 k + 1]`, written so that LLVM knows it."""
    wide = ir.VectorType(I32, BLOCK)
    products = builder.mul(builder.sext(numbers, wide), builder.sext(factors, wide))
    even, odd = (builder.shuffle_vector(products, products, order(list(range(i, BLOCK, 2)))) for i in (0, 1))
    return builder.add(even, odd)
