"""Try mutants: `python -m tools.mutate [--only TEXT ...] [--open] [--list] [--readme]`.

Lives here: a copy of the tree, one fault in it, and the tests that must notice.
Not here: the faults (`mutants`), the table of what was tried (`table`).

Why neither mutmut nor cosmic-ray: they make thousands of mutants, each with a minute of compiling here, and
numba keeps the machine code of a caller whose callee was changed, so that a mutant would be tried with the
code of before. Here each mutant of a kernel starts with an empty cache of its own. That tests pass without
a mutant is for the suite to say; a test that fails anyway would count as one that noticed.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tools.mutate.mutants import MUTANTS, Mutant
from tools.mutate.table import README, Outcome, outcomes, page, write_outcomes

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 600
NOT_COPIED = shutil.ignore_patterns(".git", ".venv*", "__pycache__", ".*_cache", ".hypothesis", "*.egg-info")
KERNELS = "kernels/"
"""The room whose mutants need kernels to be compiled again."""


def problem_of(mutant: Mutant) -> str | None:
    """Why a mutant cannot be tried: its text is gone, or stands in several places."""
    path = ROOT / "streamfeat" / mutant.file
    n = path.read_text().count(mutant.old) if path.exists() else 0
    return None if n == 1 else f"{mutant.file}: {n} places have {mutant.old.strip()[:60]!r}, 1 is wanted"


def try_mutant(mutant: Mutant, tree: Path, caches: Path) -> Outcome:
    """Run a mutant's tests on a copy of the tree with the fault in it; the copy is left as it was."""
    path = tree / "streamfeat" / mutant.file
    text, times = path.read_text(), path.stat()
    path.write_text(text.replace(mutant.old, mutant.new))
    fresh, own = mutant.file.startswith(KERNELS), tempfile.mkdtemp(dir=caches)
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "NUMBA_CACHE_DIR": own if fresh else str(caches / "shared"),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-p", "no:cacheprovider", "-rfE"]
    command += shlex.split(mutant.tests)
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Outcome("killed", f"no end after {LIMIT_S} s")
    finally:
        path.write_text(text)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # compiled kernels stay good
        shutil.rmtree(own)
    lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
    said = [line for word in ("ERROR", "FAILED") for line in lines if line.startswith(word)]
    # 1: tests failed; 2 and more: nothing was tried, which is no proof.
    verdict = {0: "survived", 1: "killed"}.get(done.returncode, "no test")
    return Outcome(verdict, (said or lines or [""])[-1][:200])


def main() -> None:
    """Try what is asked for and note it in `results.json`; status 1 where one survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[""], help="mutants with such a text in name or file")
    parser.add_argument("--open", action="store_true", help="those alone that no run has killed yet")
    parser.add_argument("--list", action="store_true", help="names alone, and texts that are not found")
    parser.add_argument("--folder", type=Path, help="of the copy and compiled kernels, kept for the next run")
    parser.add_argument("--readme", action="store_true", help="write the table of the page, try nothing")
    arguments = parser.parse_args()
    if arguments.readme:
        README.write_text(page(README.read_text()))
        return
    chosen = [m for m in MUTANTS if any(text in m.name or text in m.file for text in arguments.only)]
    if arguments.open:
        killed = {name for name, outcome in outcomes().items() if outcome.verdict == "killed"}
        chosen = [mutant for mutant in chosen if mutant.name not in killed]
    problems = [problem for mutant in chosen if (problem := problem_of(mutant))]
    if problems or not chosen:
        sys.exit("\n".join(problems) or "there is no such mutant")
    if arguments.list:
        print("\n".join(f"{mutant.file}: {mutant.name}" for mutant in chosen))
        return
    tally: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="mutants-") as passing:
        folder = arguments.folder or Path(passing)
        tree, caches = folder / "tree", folder / "caches"
        shutil.rmtree(tree, ignore_errors=True)
        shutil.copytree(ROOT, tree, ignore=NOT_COPIED)
        caches.mkdir(exist_ok=True)
        for mutant in chosen:
            started = time.monotonic()
            outcome = try_mutant(mutant, tree, caches)
            write_outcomes(outcomes() | {mutant.name: outcome})
            tally[outcome.verdict] += 1
            took = f"{time.monotonic() - started:5.0f} s"
            print(f"{outcome.verdict:9}{took}  {mutant.file}: {mutant.name}  [{outcome.said}]", flush=True)
    print(f"{len(chosen)} tried, " + ", ".join(f"{n} {verdict}" for verdict, n in sorted(tally.items())))
    sys.exit(int(tally["killed"] < len(chosen)))


if __name__ == "__main__":
    main()
