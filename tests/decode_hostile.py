"""Decodes the payloads of a file and prints what comes out, for a process with kernels of another kind."""

import os
import struct
import sys
import warnings
from pathlib import Path

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE
from streamfeat.messages import codecs

SIZE = struct.Struct("<I")


def pack(payloads):
    """Payloads as one file."""
    return b"".join(SIZE.pack(len(payload)) + payload for payload in payloads)


def unpack(data):
    """The other way."""
    at = 0
    while at < len(data):
        (size,) = SIZE.unpack_from(data, at)
        at += SIZE.size
        yield data[at : at + size]
        at += size


def decoded(data):
    """A line for each payload and encoding with state from packet to packet."""
    lines = []
    for encoding in codecs.PAYLOAD_ENCODINGS:
        decoder = codecs.make_decoder(encoding)
        for payload in unpack(data):
            try:
                events = decoder.decode(payload, 5_000)
            except InputError as error:
                lines.append(str(error))
            else:
                lines.append(f"{encoding} {events.tolist()}")
    return lines


def as_records(kernel):
    """Plain Python reads `event.x` of records only, compiled code of any structured array."""

    def reading(*arguments):
        arrays = map(np.asarray, arguments)
        return kernel(*(a.view(np.recarray) if a.dtype == EVENT_DTYPE else a for a in arrays))

    return reading


if __name__ == "__main__":
    warnings.simplefilter("error")
    if os.environ.get("NUMBA_DISABLE_JIT"):
        codecs.decode_evt3 = as_records(codecs.decode_evt3)
        codecs.decode_libcaer_cmp = as_records(codecs.decode_libcaer_cmp)
    print("\n".join(decoded(Path(sys.argv[1]).read_bytes())))
