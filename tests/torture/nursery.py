"""Real commands in processes of their own, started quickly and killed at a moment of one's choice.

Lives here: a process that has imported everything and forks for each command, so that a random moment falls
into what a command does, not into what Python imports.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

__all__ = ["Child", "Nursery", "free_port"]

_MOTHER = """
import json, os, sys, traceback
import numba, numpy, scipy.optimize, sklearn.linear_model, sklearn.model_selection, zenoh
import streamfeat.cli, streamfeat.classify.classifier, streamfeat.classify.features
import streamfeat.convert.datasets
import streamfeat.evaluate.run, streamfeat.evaluate.tables, streamfeat.learn.fit, streamfeat.live.listen
import streamfeat.live.record, torture.state

for line in sys.stdin:
    task = json.loads(line)
    pid = os.fork()
    if pid == 0:
        os.setsid()
        out = os.open(task["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        for stream in (1, 2):
            os.dup2(out, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.argv = ["streamfeat", *task["words"]]
        status = 1
        try:
            if task["words"][0] == "@listener":
                torture.state.listener(task["words"][1:])
            else:
                streamfeat.cli.main()
            status = 0
        except SystemExit as ended:
            status = ended.code or 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status if isinstance(status, int) else 1)
    print(pid, flush=True)
    # Until it is collected its number is its own, whatever became of it.
    sys.stdin.readline()
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


class Nursery:
    """Runs one command at a time; a context manager."""

    def __init__(self, root: Path) -> None:
        self._pid = 0
        """Of the command that runs; its number stays its own until it is collected."""
        path = os.pathsep.join((str(root), str(root / "tests")))
        self._mother = subprocess.Popen(
            [sys.executable, "-c", _MOTHER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={
                **os.environ,
                "PYTHONPATH": path,
                "NO_COLOR": "1",
                "OPENBLAS_NUM_THREADS": "1",
            },
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
        self._mother.kill()
        self._mother.communicate()

    def start(self, words: Sequence[object], log: Path) -> "Child":
        self._say(json.dumps({"words": [str(word) for word in words], "log": str(log)}))
        self._pid = int(self._heard())
        return Child(self._pid, log, self)

    def run(self, words: Sequence[object], log: Path) -> tuple[int, float]:
        """Run to the end: exit status and seconds."""
        started = time.monotonic()
        return self.start(words, log).wait(), time.monotonic() - started

    def _say(self, line: str) -> None:
        assert self._mother.stdin
        self._mother.stdin.write(line + "\n")
        self._mother.stdin.flush()

    def _heard(self) -> str:
        assert self._mother.stdout
        return self._mother.stdout.readline()


class Child:
    """A command that runs."""

    def __init__(self, pid: int, log: Path, nursery: Nursery) -> None:
        self.pid, self.log, self._nursery = pid, log, nursery

    def kill(self, after_s: float = 0.0) -> int:
        """Let it run so long, then `kill -9`; the exit status, -9 if it had not ended by itself."""
        time.sleep(after_s)
        os.kill(self.pid, signal.SIGKILL)
        return self.wait()

    def send(self, number: int) -> None:
        os.kill(self.pid, number)

    def wait(self) -> int:
        self._nursery._say("")
        self._nursery._pid = 0
        return int(self._nursery._heard())

    def said(self) -> Any:
        """The JSON that it printed last."""
        return json.loads(self.log.read_text().strip().splitlines()[-1])


def free_port() -> int:
    """A TCP port that nobody uses at the moment."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])
