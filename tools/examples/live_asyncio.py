"""Classify live cameras inside an asyncio program of your own.

    streamfeat publish recordings/digits_test.mcap robot/cam0/events --loop &
    python tools/examples/live_asyncio.py robot/cam0/events

Lives here: zenoh's thread on one side, an engine on the other, and what lies between: one bounded queue.
Not here: losses, restarts, many cameras, metrics; `streamfeat listen` has all of that.
"""

import asyncio
import contextlib
import sys
import time
from pathlib import Path

import zenoh

import streamfeat as sf
from streamfeat.live.network import open_session
from streamfeat.messages.packets import Packet, PacketReader
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
SCHEMA = "event_camera_msgs/msg/EventPacket"


async def packets(key: str, port: int):
    """Packets of one key as they come. The oldest of 64 is dropped when we are slow; zenoh never waits."""
    loop, reader = asyncio.get_running_loop(), PacketReader(key)
    queue: asyncio.Queue[bytes] = asyncio.Queue(64)

    def put(payload: bytes) -> None:
        if queue.full():
            queue.get_nowait()
        queue.put_nowait(payload)

    def on_sample(sample: zenoh.Sample) -> None:  # in a thread of zenoh's
        loop.call_soon_threadsafe(put, sample.payload.to_bytes())

    with open_session(None, port=port) as session:
        subscriber = session.declare_subscriber(key, on_sample)
        try:
            number = 0
            while True:
                payload, number = await queue.get(), number + 1
                with contextlib.suppress(sf.InputError):  # somebody else's bytes
                    yield reader.read(SCHEMA, payload, time.time_ns(), number)
        finally:
            subscriber.undeclare()


async def main(key: str, n_readings: int | None = None, port: int = 7447) -> list[str]:
    encoder = sf.Encoder.load(RECORDINGS / "digits.safetensors")
    classifier = sf.Classifier.load(RECORDINGS / "digits_classifier.safetensors")
    session = Session(encoder, EmitPolicy.parse("50ms"), classifier, clock=time.perf_counter)

    def process(packet: Packet) -> list[str]:
        return [str(emission.prediction) for emission in session.process(packet)]

    seen: list[str] = []
    async with contextlib.aclosing(packets(key, port)) as incoming:
        async for packet in incoming:
            # Kernels release the GIL: the loop goes on while a thread computes.
            for prediction in await asyncio.to_thread(process, packet):
                print(f"{session.stats().events:>9,} events  {prediction}")
                seen.append(prediction)
            if n_readings is not None and len(seen) >= n_readings:
                break
    return seen


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
