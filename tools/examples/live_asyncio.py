"""Classify live cameras inside an asyncio program of your own.

    streamfeat publish recordings/digits_test.mcap robot/cam0/events --loop &
    python tools/examples/live_asyncio.py 'robot/*/events'

Lives here: a program that takes predictions as they come, and says every second what was lost.
Not here: listening itself (`streamfeat.listen`), which is that of `streamfeat listen`.
"""

import asyncio
import sys
from pathlib import Path

import streamfeat as sf

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
MODEL, CLASSIFIER = RECORDINGS / "digits.safetensors", RECORDINGS / "digits_classifier.safetensors"


async def report(emissions) -> None:
    """Any other work of the program: the loop is free while threads decode and compute."""
    while True:
        await asyncio.sleep(1)
        stats = emissions.stats()
        print(f"{stats.session.events:,} events; not used: {sum(stats.drops.values())}", file=sys.stderr)


async def main(topics: str, n_emissions: int | None = None, port: int = 7447) -> list[str]:
    seen: list[str] = []
    async with sf.listen(topics, MODEL, CLASSIFIER, emit="50ms", port=port) as emissions:
        reporting = asyncio.create_task(report(emissions))
        try:
            async for emission in emissions:
                print(f"{emission.topic}  {emission.n_events:>9,} events  {emission.prediction}")
                seen.append(emission.prediction)
                if n_emissions is not None and len(seen) >= n_emissions:
                    break
        finally:
            reporting.cancel()
    return seen


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
