"""Bytes made worse: random changes of a seed, and sums mended so that a change is looked at.

Lives here: mutation, and the checksums of MCAP and zip. Not here: what is done with the bytes.
"""

import json
import random
import struct
import zlib
from collections.abc import Callable, Sequence

import lz4.frame
import zstandard

__all__ = ["mend_mcap", "mend_tensors", "mend_zip", "mutate"]

_NUMBERS = (0, 1, 2, 7, 8, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 1 << 24, (1 << 31) - 1, 1 << 31)
_LARGE = ((1 << 32) - 1, 1 << 40, (1 << 62) + 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_MOST_CHANGES = 6
_MOST_UNPACKED = 1 << 20


def mutate(
    data: bytes, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random, most: int
) -> bytes:
    """Change `data` in one to six places, as `rng` says; at most `most` bytes come out."""
    out = bytearray(data)
    for _ in range(1 + int(_MOST_CHANGES * rng.random() ** 3)):  # mostly one: more of them are refused early
        _CHANGES[_below(rng, len(_CHANGES))](out, seeds, words, rng)
    return bytes(out[:most])


def _below(rng: random.Random, n: int) -> int:
    """As `rng.randrange(n)`, in a fifth of the time."""
    return int(rng.random() * n)


def _flip(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        out[_below(rng, len(out))] ^= 1 << _below(rng, 8)


def _byte(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        out[_below(rng, len(out))] = _below(rng, 256)


def _number(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    """An integer that a length or a count could be, where one could be."""
    size = rng.choice((2, 4, 8))
    if len(out) < size:
        return
    value = rng.choice((*_NUMBERS, *_LARGE, len(out), len(out) + 1, _below(rng, 1 << 16)))
    at = _below(rng, len(out) - size + 1)
    out[at : at + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")


def _step(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    """A byte a little larger or smaller."""
    if out:
        at = _below(rng, len(out))
        out[at] = (out[at] + _below(rng, 9) - 4) & 0xFF


def _truncate(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        del out[_below(rng, len(out)) :]


def _delete(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        at = _below(rng, len(out))
        del out[at : at + 1 + _below(rng, 16)]


def _insert(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    at = _below(rng, len(out) + 1)
    out[at:at] = rng.randbytes(1 + _below(rng, 16))


def _repeat(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        at = _below(rng, len(out))
        out[at:at] = bytes(out[at : at + 1 + _below(rng, 64)]) * (1 + _below(rng, 4))


def _move(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    if out:
        source, target, n = _below(rng, len(out)), _below(rng, len(out)), 1 + _below(rng, 32)
        out[target : target + n] = out[source : source + n]


def _splice(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    """The rest of another seed from here on."""
    other = seeds[_below(rng, len(seeds))]
    if out and other:
        out[_below(rng, len(out)) :] = other[_below(rng, len(other)) :]


def _word(out: bytearray, seeds: Sequence[bytes], words: Sequence[bytes], rng: random.Random) -> None:
    """One of the words of the format, written over what is there or put in between."""
    if words:
        word, at = words[_below(rng, len(words))], _below(rng, len(out) + 1)
        out[at : at + len(word) * _below(rng, 2)] = word


_Change = Callable[[bytearray, Sequence[bytes], Sequence[bytes], random.Random], None]
_CHANGES: tuple[_Change, ...] = (
    *(_flip, _byte, _number, _step, _truncate, _delete),
    *(_insert, _repeat, _move, _splice, _word, _number, _flip),
)


def mend_mcap(data: bytes) -> bytes:
    """Make the sums of chunks right where they can be reached, and drop that of the summary."""
    out = bytearray(data)
    at = 8
    while at + 9 <= len(out):
        opcode, length = struct.unpack_from("<BQ", out, at)
        if opcode == 0x06 and at + 49 <= len(out) and length <= len(out):
            (name_length,) = struct.unpack_from("<I", out, at + 37)
            name = bytes(out[at + 41 : at + 41 + min(name_length, 8)])
            content = _unpacked(name, bytes(out[at + 49 + min(name_length, 8) : at + 9 + length]))
            if content is not None:
                struct.pack_into("<QI", out, at + 25, len(content), zlib.crc32(content))
        elif opcode == 0x02 and length == 20 and at + 29 <= len(out):
            struct.pack_into("<I", out, at + 25, 0)
        at += 9 + length
    return bytes(out)


def _unpacked(compression: bytes, data: bytes) -> bytes | None:
    try:
        if compression == b"zstd":
            return zstandard.ZstdDecompressor().stream_reader(data).read(_MOST_UNPACKED)
        if compression == b"lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=_MOST_UNPACKED)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
        return None
    return data if compression == b"" else None


def mend_tensors(data: bytes) -> bytes:
    """Give a safetensors header the length that it has, and the tensors the bytes that it claims."""
    end = data.rfind(b"}}") + 2
    head = data[8:end]
    try:
        tensors = [value for value in json.loads(head).values() if "data_offsets" in value]
        size = max(tensor["data_offsets"][1] for tensor in tensors)
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError):
        return data
    if not isinstance(size, int) or not 0 <= size <= _MOST_UNPACKED:
        return data
    head += b" " * (-len(head) % 8)
    return struct.pack("<Q", len(head)) + head + data[end:].lstrip(b" ")[:size].ljust(size, b"\0")


def mend_zip(data: bytes) -> bytes:
    """Make the CRCs of members that are stored as they are right."""
    out = bytearray(data)
    at = out.find(b"PK\1\2")
    while 0 <= at <= len(out) - 46:
        method, size, offset = (
            *struct.unpack_from("<H", out, at + 10),
            *struct.unpack_from("<I", out, at + 20),
            *struct.unpack_from("<I", out, at + 42),
        )
        if method == 0 and offset + 30 <= len(out):
            start = offset + 30 + sum(struct.unpack_from("<2H", out, offset + 26))
            crc = zlib.crc32(out[start : start + size])
            struct.pack_into("<I", out, at + 16, crc)
            struct.pack_into("<I", out, offset + 14, crc)
        at = out.find(b"PK\1\2", at + 46)
    return bytes(out)
