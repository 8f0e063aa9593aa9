"""The list of mutants: which text becomes which other, and the tests that must notice.

Lives here: data, room by room. Not here: how they are tried (`__main__`).
`old` stands exactly once in its file; `tools/tests/test_mutate.py` fails where that is no longer so.
"""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One fault.

    Attributes:
        name: unique.
        file: below `streamfeat/`.
        old: text that stands exactly once in it.
        new: what takes its place.
        tests: arguments for pytest, from the root of the repository.
        why: of a survivor, why no test can notice it.
    """

    name: str
    file: str
    old: str
    new: str
    tests: str
    why: str = ""


MARKED = "tests/test_kernels.py -k 'every_case and mark_dirty'"
MARKING = "tests/test_kernels.py -k 'mark_dirty or update or settle'"
INGEST = "tests/test_kernels.py -k 'count_event or advance_to_bin'"
SESSION = "tests/test_session.py"
SHARD = "tests/test_live_shard.py -k share"
RECORDING = "tests/test_recording.py"

MUTANTS = [
    # kernels
    Mutant(
        "mark_dirty forgets the partly projected volume",
        "kernels/update.py",
        "inside = volume < last or (volume == last and line_entry - c * stride < last_entry)",
        "inside = volume < last",
        MARKED,
    ),
    Mutant(
        "mark_dirty takes every entry of that volume",
        "kernels/update.py",
        "(volume == last and line_entry - c * stride < last_entry)",
        "volume == last",
        MARKED,
    ),
    Mutant(
        "settle keeps flags",
        "kernels/update.py",
        "        flags[place] = 0\n",
        "        flags[place] = 1\n",
        MARKING,
    ),
    Mutant(
        "a bin that leaves is not cleared",
        "kernels/ingest.py",
        "        counts[b % n_bins] = 0\n",
        "        counts[b % n_bins] += 0\n",
        INGEST,
    ),
    Mutant(
        "too old by one bin is not late",
        "kernels/ingest.py",
        "        if position < 0:\n",
        "        if position < -1:\n",
        INGEST,
    ),
    Mutant(
        "a polarity of 2 is sound",
        "kernels/ingest.py",
        "inside and p >> 1 == 0 and",
        "inside and p >> 2 == 0 and",
        INGEST,
    ),
    Mutant(
        "saturated is never counted on the short way",
        "kernels/ingest.py",
        "n_saturated += not changed",
        "n_saturated += 0",
        INGEST,
    ),
    # engine
    Mutant(
        "a snapshot keeps the codes of the other plane",
        "engine/engine.py",
        "            state.atoms[np.arange(len(state.atoms)) != state.clock[CLOCK_PLANE]] = 0\n",
        "",
        "tests/test_state.py -k 'codes_of_a_snapshot_alone'",
    ),
    # stream
    Mutant(
        "look-ahead without bound on columns",
        "stream/session.py",
        "_AHEAD_COLUMNS = 4096",
        "_AHEAD_COLUMNS = 1 << 40",
        "tests/test_session.py -k ahead",
    ),
    Mutant(
        "look-ahead without rest",
        "stream/session.py",
        "self._ahead_from = now + 2 * (self._clock() - now)",
        "self._ahead_from = now",
        "tests/test_session.py -k ahead",
    ),
    Mutant(
        "look-ahead where the policy is auto",
        "stream/session.py",
        'if self._engine and self.policy.kind != "auto" and now >= self._ahead_from:',
        "if self._engine and now >= self._ahead_from:",
        "tests/test_session.py -k ahead",
    ),
    Mutant(
        "an event at the end of a sample is inside",
        "stream/session.py",
        "np.searchsorted(latest, state.sample_end_us)",
        'np.searchsorted(latest, state.sample_end_us, "right")',
        SESSION,
    ),
    Mutant(
        "events before a sample are used",
        "stream/session.py",
        "        if early.any():\n".replace("        if", "            if"),
        "            if not early.any():\n",
        SESSION,
    ),
    Mutant(
        "missing packets stay in the window for ever less one",
        "stream/state.py",
        "int(latest[0]) + window_us)",
        "int(latest[0]))",
        SESSION,
    ),
    Mutant(
        "a new epoch keeps the window",
        "stream/session.py",
        "        self._state.begin_epoch(epoch)\n        self._restart()\n",
        "        self._state.begin_epoch(epoch)\n",
        SESSION,
    ),
    Mutant(
        "a due emission is one step late",
        "stream/state.py",
        "% self.every_us + self.every_us",
        "% self.every_us + 2 * self.every_us",
        SESSION,
    ),
    Mutant(
        "an emission in silence is dated back by the next event",
        "stream/state.py",
        "        t_us = max(t_us, self.silent_us)\n",
        "",
        SESSION,
    ),
    Mutant(
        "another policy goes on with what was due under the one before",
        "stream/state.py",
        "self.next_us if every_us == self.every_us else None",
        "self.next_us",
        "tests/test_state.py",
    ),
    Mutant(
        "a cancelled task leaves its thread behind",
        "stream/threads.py",
        "while not work.done():",
        "while False:",
        "tests/test_async.py -k 'cancelled_call'",
    ),
    Mutant(
        "StopIteration of a sink is lost in the event loop",
        "stream/threads.py",
        "_NOT_FOR_LOOPS = StopIteration, StopAsyncIteration",
        "_NOT_FOR_LOOPS = StopAsyncIteration, StopAsyncIteration",
        "tests/test_async.py -k errors_of --timeout 60",
    ),
    Mutant(
        "emissions wait without bound for a program",
        "stream/emission_stream.py",
        "len(emissions) <= _WAITING",
        "len(emissions) <= 1e9",
        "tests/test_async.py -k find_no_room",
    ),
    Mutant(
        "a cancelled stream does not release the thread that waits for room",
        "stream/emission_stream.py",
        "            self._queue.abandon()\n            running.cancel()\n",
        "            running.cancel()\n",
        "tests/test_async.py -k 'loop_that_ends or cancelled_at'",
    ),
    Mutant(
        "sinks are closed as done after a failure",
        "stream/pipeline.py",
        "failed=failure is not None",
        "failed=False",
        "tests/test_pipeline.py",
    ),
    Mutant(
        "the correct are not counted",
        "stream/session.py",
        "            self._stats.correct += 1\n",
        "            self._stats.correct += 0\n",
        "tests/test_session.py",
    ),
    Mutant(
        "learning before predicting is never",
        "stream/session.py",
        "self.learner.learn_one(emission.features, sample.label)",
        "pass",
        "tests/test_session.py",
    ),
    Mutant(
        "1ms is a microsecond",
        "stream/emission.py",
        '"ms": 1_000,',
        '"ms": 1,',
        "tests/test_session.py",
    ),
    Mutant(
        "a camera more than the limit is served",
        "stream/cameras.py",
        "if len(self._sessions) >= self._limit:",
        "if len(self._sessions) > self._limit:",
        "tests/test_cameras.py",
    ),
    Mutant(
        "what a refused camera did is forgotten",
        "stream/cameras.py",
        '            self._refuse(item.topic, "unusable", str(error))\n            self._past = _sum(',
        '            self._refuse(item.topic, "unusable", str(error))\n            _sum(',
        "tests/test_cameras.py",
    ),
    Mutant(
        "a camera that left stays",
        "stream/cameras.py",
        "        finally:\n            self._past = _sum([self._past, session.stats()])\n            del self._sessions[topic]",
        "        finally:\n            self._past = _sum([self._past, session.stats()])",
        "tests/test_cameras.py",
    ),
    # messages
    Mutant(
        "a gap breaks no decoder",
        "messages/delivery.py",
        "broken=lost + dropped > 0)",
        "broken=False)",
        "tests/test_live_delivery.py",
    ),
    Mutant(
        "dropped counts as lost too",
        "messages/delivery.py",
        "lost = max(gap - dropped, 0)",
        "lost = max(gap, 0)",
        "tests/test_live_delivery.py",
    ),
    Mutant(
        "a second publisher is used",
        "messages/delivery.py",
        "return Verdict(use=False, lost=dropped, foreign=True)",
        "return Verdict(use=True, lost=dropped, foreign=True)",
        "tests/test_live_delivery.py",
    ),
    Mutant(
        "missing numbers without bound",
        "messages/delivery.py",
        "for missing in range(seq - min(lost, _REMEMBERED), seq):",
        "for missing in range(seq - min(lost, 1), seq):",
        "tests/test_live_delivery.py",
    ),
    Mutant(
        "the product's tile that is not full is left out",
        "kernels/dense.py",
        "whole = waiting if rest >= WORTH_A_TILE else waiting - rest",
        "whole = waiting - rest",
        "tests/test_kernels.py -k 'every_case and multiply'",
        "columns are added instead: the same bits, and slower where four or five volumes are left",
    ),
    Mutant(
        "volumes that wait keep entries of the bin after next",
        "kernels/dense.py",
        "        values[end:] = 0\n",
        "",
        "tests/test_kernels.py -k 'every_case and let_in'",
    ),
    Mutant(
        "the last volumes that wait are never projected",
        "kernels/planes.py",
        "if waiting > 0 and (waiting == state.awaiting.shape[1] or i == last - 1):",
        "if waiting > 0 and waiting == state.awaiting.shape[1]:",
        "tests/test_invariants.py -k where_volumes_are_full",
    ),
    Mutant(
        "mono: polarity of the wrong bit",
        "kernels/decode.py",
        "out[i].p = word >> 63",
        "out[i].p = (word >> 62) & 1",
        "tests/test_codecs.py",
    ),
    Mutant(
        "mono: nanoseconds of the base are dropped",
        "kernels/decode.py",
        "(rest_ns + np.int64(word & 0xFFFFFFFF)) // 1000",
        "np.int64(word & 0xFFFFFFFF) // 1000",
        "tests/test_codecs.py",
    ),
    Mutant(
        "libcaer: every fall is a wrap",
        "messages/codecs.py",
        "np.diff(us, prepend=us[:1]) < -_LIBCAER_WRAP_US // 2)",
        "np.diff(us, prepend=us[:1]) < 0)",
        "tests/test_codecs.py",
    ),
    Mutant(
        "a decoder takes a snapshot of any length",
        "messages/codecs.py",
        "        if len(state) != len(self._state):\n",
        "        if len(state) > len(self._state) + 99:\n",
        "tests/test_codecs.py -k another_length",
    ),
    # recordings
    Mutant(
        "an event at the end belongs to a sample",
        "recordings/samples.py",
        "(t >= self.label.start_us) & (t < self.end_us)",
        "(t >= self.label.start_us) & (t <= self.end_us)",
        RECORDING,
    ),
    Mutant(
        "an event at the start does not",
        "recordings/samples.py",
        "(t >= self.label.start_us) &",
        "(t > self.label.start_us) &",
        RECORDING,
    ),
    Mutant(
        "a sample ends one packet late",
        "recordings/samples.py",
        "now >= pending[0].end_us",
        "now > pending[0].end_us",
        RECORDING,
    ),
    Mutant(
        "open samples without bound",
        "recordings/samples.py",
        "if len(pending) == _MOST_OPEN:",
        "if len(pending) == 10**9:",
        RECORDING,
    ),
    Mutant(
        "two damaged bytes are a beginning",
        "recordings/records.py",
        "len(wrong) > 1 or _VERSION_AT in wrong",
        "len(wrong) > 2 or _VERSION_AT in wrong",
        RECORDING,
    ),
    Mutant(
        "a rescan begins inside a good chunk",
        "recordings/records.py",
        "            trusted = after\n",
        "            trusted = at\n",
        "tests/test_recording.py -k inside_a_good_chunk",
    ),
    Mutant(
        "labels are not shifted on --loop",
        "recordings/reader.py",
        "start_us=item.start_us + shift_us",
        "start_us=item.start_us",
        "tests/test_recording.py -k played_again",
    ),
    Mutant(
        "losses of a part are not added",
        "recordings/losses.py",
        "self.counts, self.bytes = self.counts + others.counts, self.bytes + others.bytes",
        "self.bytes = self.bytes + others.bytes",
        RECORDING + " tests/test_parts.py tests/test_bags.py",
    ),
    # files
    Mutant(
        "half a file takes the place",
        "files/atomic.py",
        "        yield temporary\n        temporary.chmod(0o666 & ~_umask())\n        temporary.replace(target)\n    finally:\n",
        "        yield temporary\n    finally:\n        temporary.chmod(0o666 & ~_umask())\n        temporary.replace(target)\n",
        "tests/test_atomic.py",
    ),
    Mutant(
        "a second writer waits for no lock",
        "files/outputs.py",
        "fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)",
        "tests/test_outputs.py",
    ),
    Mutant(
        "a part that was renamed meanwhile is taken",
        "files/outputs.py",
        "if os.path.samestat(os.fstat(file.fileno()), path.stat()):",
        "if True:",
        "tests/test_outputs.py",
    ),
    Mutant(
        "the lock goes before the name",
        "files/outputs.py",
        "if self.part and fcntl:  # before",
        "if self.part and not fcntl:  # before",
        "tests/test_outputs.py",
    ),
    Mutant(
        "sweep takes others' files",
        "files/atomic.py",
        r'rf"\.{re.escape(path.name)}\.[a-z0-9_]+{re.escape(_SUFFIX)}"',
        r'rf".*{re.escape(_SUFFIX)}"',
        "tests/test_atomic.py",
    ),
    Mutant(
        "true is a number",
        "files/json_fields.py",
        "if type(value) is not kind or not is_valid(value):",
        "if not isinstance(value, kind) or not is_valid(value):",
        "tests/test_json_fields.py",
    ),
    Mutant(
        "a list without bound",
        "files/json_fields.py",
        "values = self._checked(name, list, lambda value: len(value) <= longest)",
        "values = self._checked(name, list)",
        "tests/test_json_fields.py",
    ),
    Mutant(
        "another version is read",
        "files/safetensors_file.py",
        'if header.get("version") != version:',
        'if header.get("version") is None:',
        "tests/test_golden.py -k version",
    ),
    Mutant(
        "another kind is read",
        "files/safetensors_file.py",
        'header.get("format") not in kinds',
        'header.get("format") is None',
        "tests/test_golden.py -k kind",
    ),
    # classify
    Mutant(
        "a tie goes to the larger C",
        "classify/classifier.py",
        "best = max(scores, key=lambda c: (scores[c], -c))",
        "best = max(scores, key=lambda c: (scores[c], c))",
        "tests/test_classifier.py -k smaller_c",
    ),
    Mutant(
        "a tie goes to the larger power",
        "classify/classifier.py",
        "        best = max(found, key=lambda p: (found[p], -p))\n        error",
        "        best = max(found, key=lambda p: (found[p], p))\n        error",
        "tests/test_classifier.py -k search_for_c",
    ),
    Mutant(
        "a negative scale is read",
        "classify/classifier.py",
        '(arrays["scale"] > 0).all()',
        '(arrays["scale"] > -1e9).all()',
        "tests/test_classifier.py",
    ),
    Mutant(
        "the SVM forgets its bias",
        "classify/svm.py",
        "gradient[-1] = pull.sum(axis=0)",
        "gradient[-1] = 0",
        "tests/test_classifier.py",
    ),
    Mutant(
        "two classes change sides",
        "classify/svm.py",
        "best = (scores > 0).astype(int)",
        "best = (scores < 0).astype(int)",
        "tests/test_classifier.py",
    ),
    # learn
    Mutant(
        "whitening without its small number",
        "learn/whitening.py",
        "np.sqrt(values.clip(min=0.0) + self.eps_zca)",
        "np.sqrt(values.clip(min=1e-12))",
        "tests/test_learn.py",
    ),
    Mutant(
        "the mean is not subtracted",
        "learn/whitening.py",
        "(_normalised(volumes[rows], self.eps) - self.mean_) @ self.whitening_",
        "_normalised(volumes[rows], self.eps) @ self.whitening_",
        "tests/test_learn.py",
    ),
    # evaluate
    Mutant(
        "confusion is turned around",
        "evaluate/scores.py",
        "([place[name] for name in true], [place[name] for name in predicted])",
        "([place[name] for name in predicted], [place[name] for name in true])",
        "tests/test_evaluate.py",
    ),
    Mutant(
        "a fold's event at the end of a held-out sample is dropped",
        "evaluate/splits.py",
        "outside = (t < 0) | (t >= left_out.duration_us)",
        "outside = (t < 0) | (t > left_out.duration_us)",
        "tests/test_evaluate.py -k only_the_events_of_a_held_out",
    ),
    # live
    Mutant(
        "a process that was stopped counts as silence",
        "live/intake.py",
        "passed_s = min(now - looked, 2 * _POLL_S)",
        "passed_s = now - looked",
        "tests/test_early_labels.py",
    ),
    Mutant(
        "early labels without bound",
        "live/intake.py",
        "while len(self._early) > MAX_TOPICS:",
        "while len(self._early) > 10**9:",
        "tests/test_early_labels.py",
    ),
    Mutant(
        "a label far away is accepted",
        "live/intake.py",
        "if abs(ahead_us) > _MAX_SPAN_US:",
        "if abs(ahead_us) > 10**18:",
        "tests/test_early_labels.py",
    ),
    Mutant(
        "a full inbox drops nothing",
        "live/inbox.py",
        "self._bytes > self._max_bytes or",
        "False or",
        "tests/test_live_inbox.py",
    ),
    Mutant(
        "what has waited too long is taken",
        "live/inbox.py",
        "self._drop_oldest(time.monotonic_ns() - self._max_delay_ns)",
        "pass",
        "tests/test_live_inbox.py",
    ),
    Mutant(
        "the drop is told to nobody",
        "live/inbox.py",
        "item.dropped = self._dropped.pop(item.topic, 0)",
        "item.dropped = 0",
        "tests/test_live_inbox.py",
    ),
    Mutant(
        "a closed inbox takes more",
        "live/inbox.py",
        "            if self._closed:\n                return\n",
        "",
        "tests/test_live_inbox.py",
    ),
    Mutant(
        "share N of N",
        "live/shard.py",
        "if shard.index >= shard.of:",
        "if shard.index > shard.of:",
        SHARD,
    ),
    Mutant(
        "labels go elsewhere than their camera",
        "live/shard.py",
        'parent if last in ("events", "label") else topic',
        'parent if last == "events" else topic',
        SHARD,
    ),
    Mutant(
        "shares of another order of bytes",
        "live/shard.py",
        '.digest(), "big")',
        '.digest(), "little")',
        SHARD,
    ),
    Mutant(
        "a state says more than was written",
        "live/checkpoint.py",
        "self._written >= self._taken.made",
        "True",
        "tests/test_state.py -k 'never_says_more'",
    ),
    Mutant(
        "a state of another model is taken",
        "live/checkpoint.py",
        'if values.text("fingerprint") != fingerprint:',
        'if not values.text("fingerprint"):',
        "tests/test_state.py -k another_model",
    ),
    # latency, view
    Mutant(
        "a percentile with nothing beyond is told",
        "latency/histogram.py",
        "if self.n * (100 - percent) < 100 * (1 - 1e-9):",
        "if self.n * (100 - percent) < 0:",
        "tests/test_latency.py",
    ),
    Mutant(
        "an empty volume is faint",
        "view/pictures.py",
        "np.where(activity > 0, np.round(",
        "np.where(activity >= 0, np.round(",
        "tests/test_view_pictures.py",
    ),
    Mutant(
        "ON is dark",
        "view/pictures.py",
        'np.where(events["p"], level, -level)',
        'np.where(events["p"], -level, level)',
        "tests/test_view_pictures.py",
    ),
    Mutant(
        "negative parts are shown up",
        "view/pictures.py",
        "cells.clip(0), (-cells).clip(0)",
        "cells.clip(0), cells.clip(0)",
        "tests/test_view_pictures.py",
    ),
    Mutant(
        "the pixel nearest to nothing is kept",
        "view/pictures.py",
        "np.abs(blocks.astype(np.int16) - nothing).argmax(axis=2)",
        "np.abs(blocks.astype(np.int16) - nothing).argmin(axis=2)",
        "tests/test_view_pictures.py",
    ),
    # events, engine, work, camera files, simulate, convert
    Mutant(
        "OFF as -1 stays -1 where the batch begins with ON",
        "events.py",
        "    is_minus = p == -1\n",
        "    is_minus = p[:1] == -1\n",
        "tests/test_conventions.py",
    ),
    Mutant(
        "counts of a window are clipped from above alone",
        "engine/window.py",
        "counts.clip(-geometry.max_count, geometry.max_count)",
        "counts.clip(None, geometry.max_count)",
        "tests/test_encoder.py -k counts_of_a_window",
    ),
    Mutant(
        "sums are added in the order in which they come",
        "work/workers.py",
        "while waiting and waiting[-1][0] == height:",
        "while waiting:",
        "tests/test_cluster.py -k one_tree",
    ),
    Mutant(
        "a late event from before a wrap is after it",
        "camera_files/prophesee.py",
        " - (steps > half))",
        ")",
        "tests/test_event_files.py -k from_before_a_wrap",
    ),
    Mutant(
        "there is something before the first wrap",
        "camera_files/prophesee.py",
        "        np.maximum(wraps, 0, out=wraps)\n",
        "",
        "tests/test_event_files.py -k first_turn_of_a_clock",
    ),
    Mutant(
        "noise comes in the refractory time",
        "simulate/camera.py",
        "kept = _outside_refractory(known, self._model.resolution, dead_us)",
        "kept = _outside_refractory(known, self._model.resolution, 0)",
        "tests/test_simulate.py",
    ),
    Mutant(
        "every fifth but one is validation",
        "convert/splits.py",
        '"train" if seen % every else "validation"',
        '"validation" if seen % every else "train"',
        "tests/test_datasets.py",
    ),
    Mutant(
        "block 1 of 5 is the second",
        "convert/splits.py",
        "number == block - 1",
        "number == block",
        "tests/test_datasets.py",
    ),
]
