"""Interrupts: heard within a second though the main thread is busy, and nothing lost that was promised."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from streamfeat.work import interrupts
from streamfeat.work.interrupts import AGAIN_S, GRACE_S, deferred, kept_by

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parents[1]
HEARD_S = 2
"""Within a second, on a machine that does nothing else."""

HEAD = """
import ctypes, os, signal, sys, time
from pathlib import Path
from streamfeat.work import interrupts
busy = ctypes.CDLL(None).usleep  # no Python handler runs before it returns
interrupts.start()
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])  # or the call would end early
"""
BODIES = {
    "imports": "say(); busy(10_000_000)",
    "nothing promised": """
from streamfeat.files.outputs import OutputFile, remove_unfinished
interrupts.hear()
interrupts.at_leaving(remove_unfinished)
interrupts.last_words('interrupted; nothing was written')
with OutputFile(Path('out')) as output:
    say(); busy(10_000_000)
""",
    "swallowed": """
interrupts.hear()
say()
while True:
    try:
        time.sleep(10)
    except KeyboardInterrupt:
        pass
""",
    "promised": """
interrupts.hear()
try:
    with interrupts.promised():
        say(); interrupts.aside(busy, 10_000_000)
except KeyboardInterrupt:
    busy(1_000_000 if SLOW else 0)
    print('kept')
interrupts.end(130)
""",
    "kept": """
interrupts.hear()
ended = []
with interrupts.deferred():
    with interrupts.kept_by(lambda: ended.append(1)):
        say()
        while not ended:
            busy(10_000)
        busy(1_000_000 if SLOW else 0)
    print('kept')
interrupts.end(130)
""",
    "deferred": "interrupts.hear()\nwith interrupts.deferred():\n    say(); busy(10_000_000)",
}


def interrupted(body, folder, *moments_s, slow=False, number=signal.SIGINT):
    """What a program says that is interrupted so many seconds after it is ready, its status, and how long."""
    code = f"{HEAD}\nSLOW = {slow}\nsay = lambda: print('ready', flush=True)\n{BODIES[body]}"
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as process:
        assert process.stdout.readline() == "ready\n"
        for moment in moments_s or (0.05,):
            time.sleep(moment)
            process.send_signal(number)
        sent = time.monotonic()
        out, err = process.communicate(timeout=20)
    assert process.returncode == 130
    return out, err, time.monotonic() - sent


@pytest.mark.parametrize("body", ["imports", "nothing promised", "swallowed", "deferred"])
def test_a_command_ends_though_its_main_thread_is_busy(body, tmp_path):
    out, err, took = interrupted(body, tmp_path, number=signal.SIGTERM)
    assert took < HEARD_S
    assert (out, err) == ("", "interrupted; nothing was written\n" if body == "nothing promised" else "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("body", ["promised", "kept"])
def test_what_is_promised_has_so_long_as_it_takes(body, tmp_path):
    out, err, took = interrupted(body, tmp_path, slow=True)
    assert (out, err) == ("kept\n", "")
    assert took > 2 * GRACE_S


@pytest.mark.parametrize("body", ["promised", "kept"])
def test_a_second_interrupt_ends_at_once_and_an_echo_does_not(body, tmp_path):
    out, _, took = interrupted(body, tmp_path, 0.05, AGAIN_S + 0.2, slow=True)
    assert (out, took < 0.4) == ("", True)
    out, _, took = interrupted(body, tmp_path, 0.05, 0.01)
    assert (out, took < HEARD_S) == ("kept\n", True)


def test_a_program_that_calls_the_package_is_asked_and_never_ended():
    """Its handlers come back; the thread that hears ends with the block."""
    before, asked = signal.getsignal(signal.SIGTERM), []
    threads = threading.active_count()
    with kept_by(lambda: asked.append(1)):
        os.kill(os.getpid(), signal.SIGTERM)
        while not asked:
            time.sleep(0.01)
    with pytest.raises(KeyboardInterrupt), deferred():
        signal.raise_signal(signal.SIGTERM)
    assert interrupts.aside(lambda: threading.current_thread()) is threading.main_thread()
    assert signal.getsignal(signal.SIGTERM) is before
    assert threading.active_count() == threads


def test_a_signal_of_a_child_that_was_forked_is_its_own():
    asked = []
    with kept_by(lambda: asked.append(1)):
        if not (child := os.fork()):
            signal.raise_signal(signal.SIGTERM)
            os._exit(3)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    assert not asked
