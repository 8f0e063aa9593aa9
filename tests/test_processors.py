"""The same bits on a processor without wide vectors: the plain path is tried in a process of its own."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from streams import EXACT_KINDS, Case, random_events

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry

CASES = {
    f"{formulation}-{encoding}-{n_filters}{'-narrow' if narrow else ''}": Case(
        Geometry(patch=patch, stride=3, n_bins=3, bin_us=1000, max_count=2),
        (31, 42),
        n_filters,
        formulation,
        encoding,
        0.1,
        3,
        narrow=narrow,
    )
    for n_filters, patch in ((33, 4), (130, 9))
    for formulation, encoding in EXACT_KINDS
    for narrow in (False, True)[: 2 if formulation == "direct" and encoding != "triangle" else 1]
}


def digests():
    """What features are after every piece of a stream, fed and followed."""
    found = {}
    for name, case in CASES.items():
        engine, digest = Engine(case.encoder, case.resolution, threads=2), hashlib.sha256()
        events = random_events(np.random.default_rng(1), case.geometry, case.resolution, 4000, n_windows=2)
        for i, piece in enumerate(np.array_split(events, 9)):
            (engine.follow if i % 3 == 2 else engine.feed)(piece)
            digest.update(engine.features().tobytes())
            digest.update(engine.codes().tobytes())
        found[name] = digest.hexdigest()
    return found


def test_features_have_the_same_bits_on_a_processor_without_wide_vectors():
    environment = os.environ | {"NUMBA_CPU_NAME": "generic"}
    done = subprocess.run(
        [sys.executable, __file__], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == digests()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    print(json.dumps(digests()))
