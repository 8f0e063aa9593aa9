"""Emissions in a running loop: the same as of the command, and nothing is left when iteration is left."""

import asyncio
import threading
from contextlib import aclosing

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.stream.replay import ReplayJob

MODEL = tiny.encoder()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("emissions")
    MODEL.save(folder / "model")
    tiny.classifier(MODEL).save(folder / "classifier")
    tiny.write_items(folder / "rec.mcap", tiny.labelled_items(6))
    return folder


class Kept:
    def __init__(self):
        self.emissions = []

    def write(self, emissions):
        self.emissions += emissions

    def close(self, *, failed):
        pass


def test_they_are_those_of_the_command(files):
    kept = Kept()
    parts = files / "rec.mcap", files / "model", files / "classifier"
    ReplayJob(*parts, emit="1ms").run(more=kept)

    async def collect():
        emissions = sf.replay(*parts, emit="1ms")
        return [emission async for emission in emissions], emissions.stats()

    found, stats = asyncio.run(collect())
    assert stats.emissions == len(found) == len(kept.emissions) > 400
    for one, other in zip(found, kept.emissions, strict=True):
        assert (one.t_us, one.prediction, one.final) == (other.t_us, other.prediction, other.final)
        np.testing.assert_array_equal(one.features, other.features)


def threads():
    return {thread.name for thread in threading.enumerate() if thread.name.startswith("streamfeat")}


@pytest.mark.parametrize("after", [0, 1, 2, 300])
def test_nothing_is_left_when_iteration_is_left(files, after):
    async def leave():
        async with aclosing(aiter(sf.replay(files / "rec.mcap", MODEL, emit="event"))) as emissions:
            n = 0
            async for _ in emissions:
                n += 1
                if n > after:
                    break
        assert threads() == set()

    asyncio.run(leave())


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 5, 8, 20, 60])
def test_nothing_is_left_after_a_cancellation(files, steps):
    async def consume():
        async with aclosing(
            aiter(sf.replay(files / "rec.mcap", MODEL, emit="event", speed=0.5))
        ) as emissions:
            async for _ in emissions:
                pass

    async def cancel():
        task = asyncio.create_task(consume())
        for _ in range(steps):
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert threads() == set()

    asyncio.run(cancel())


def test_an_error_comes_out_of_the_iteration(files, monkeypatch):
    def broken(self, item):
        raise RuntimeError("broken")

    monkeypatch.setattr("streamfeat.stream.session.Session.process", broken)

    async def run():
        async for _ in sf.replay(files / "rec.mcap", MODEL):
            pass

    with pytest.raises(RuntimeError, match="broken"):
        asyncio.run(run())
    assert threads() == set()


def test_what_cannot_be_is_said_at_once(files):
    with pytest.raises(sf.InputError, match="--emit"):
        sf.replay(files / "rec.mcap", MODEL, emit="sometimes")
