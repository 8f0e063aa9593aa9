"""Encoded features kept in a directory, so that other runs on the same samples need not encode again.

Lives here: the name of a file, what has to be the same for it to be read, reading and writing it.
Not here: encoding (`classify.features`), finished cells (`run`).
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.classify.features import EncodedSamples, encode_recordings
from streamfeat.classify.variants import PLAIN, Variant
from streamfeat.engine.encoder import FeatureMap
from streamfeat.errors import InputError
from streamfeat.evaluate.splits import DataSet
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.recordings.reader import Recording
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["FeatureFiles"]

_KIND, _VERSION = "streamfeat-features", 1


class FeatureFiles:
    """A directory with a file for each encoder, set of samples and variant.

    An encoder gives the same bits everywhere, so what is read is what would have been encoded.

    Args:
        directory: made if it is not there.
        data: the samples.

    Raises:
        InputError: the directory cannot be made.
    """

    def __init__(self, directory: Path, data: DataSet) -> None:
        """Make the directory."""
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{directory}: cannot be made: {error.strerror}") from None
        labels = hashlib.sha256(repr(data.labels).encode()).hexdigest()
        self._directory, self._splits = directory, data.held_out(0) is None
        self._samples = data.identity | {"topic": data.topic, "labels": labels}

    def encoded(
        self,
        encoder: FeatureMap,
        recordings: Sequence[Recording],
        report: Callable[[str, int, int, str], None],
        *,
        variant: Variant = PLAIN,
        held_out_too: bool = False,
        workers: Workers = THIS_PROCESS,
    ) -> EncodedSamples:
        """What `encode_recordings` gives, from a file if there is one; else it is written.

        Raises:
            InputError: a file cannot be read or written, or holds something else.
        """
        header = {
            "encoder": encoder.fingerprint,
            "samples": self._samples,
            "variant": str(variant),
            "held_out_too": held_out_too and self._splits,
        }
        digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()[:24]
        path = self._directory / f"{digest}.features"
        if path.exists():
            return _read(path, header, encoder)
        found = encode_recordings(
            encoder, recordings, report, variant=variant, held_out_too=held_out_too, workers=workers
        )
        texts = {"labels": found.labels.tolist(), "sources": found.sources.tolist()}
        arrays = {"rows": found.rows, "held_out": found.held_out}
        write_safetensors(path, _KIND, _VERSION, arrays, header | texts)
        return found


def _read(path: Path, header: dict[str, Any], encoder: FeatureMap) -> EncodedSamples:
    arrays, found = read_safetensors(path, _KIND, _VERSION)
    rows, held_out = arrays.get("rows", np.zeros(0)), arrays.get("held_out", np.zeros(0))
    labels, sources = found.get("labels"), found.get("sources")
    if (
        {name: found.get(name) for name in header} != header
        or rows.dtype != np.float32
        or rows.shape != (len(held_out), encoder.n_features)
        or held_out.dtype != bool
        or not all(isinstance(texts, list) and len(texts) == len(rows) for texts in (labels, sources))
    ):
        raise InputError(f"{path}: does not hold the features that its name says; delete it")
    return EncodedSamples(rows, np.array(labels, str), np.array(sources, str), held_out)
