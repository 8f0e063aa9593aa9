"""What commands print as their result: the fields of `--json`.

Lives here: each field of each command with its type, its meaning, and its name in the table for people.
Not here: where the figures come from (each command), and how results are rendered (`rendering`).
"""

from dataclasses import dataclass

__all__ = ["RESULTS", "Field"]


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a result.

    Attributes:
        kind: `text`, `int`, `number`, `bool`, `object`; `[int]` a list, `{int}` values by name; `int?` is
            null where there is no such number.
        means: what it says, in one line.
        shown: its name in the table for people; as in JSON, with spaces, if empty.
        quiet: whether people see it only when it is not 0, or not false.
        hidden: whether people do not see it.
    """

    kind: str
    means: str
    shown: str = ""
    quiet: bool = False
    hidden: bool = False


def _counts(**means: str) -> dict[str, Field]:
    """Counters that matter only when they are not 0."""
    return {name: Field("int", said, quiet=True) for name, said in means.items()}


_WRITTEN = Field("text", "the file that was written")
_INTERRUPTED = Field("bool", "whether Ctrl-C or SIGTERM ended it", quiet=True)
_REMOVED = Field("{int}", "events taken out as noise, by filter", "taken out")
_SCORED = {
    "samples": Field("int", "labelled samples that ended", quiet=True),
    "correct": Field("int?", "those that were predicted right; null without labels or classifier"),
    "accuracy": Field("number?", "their share"),
}
_UNUSED = _counts(
    late="events older than the window, which change nothing",
    rejected="events outside the sensor, or malformed",
    lost="packets that never arrived, or chunks and packets that could not be read",
)
_DELIVERY = _counts(
    duplicates="packets that came twice",
    reordered="packets that came out of order and were used",
    restarts="starts of the camera's clock or of its publisher",
)
_ARRIVAL = {
    "unheard": Field(
        "int", "packets published before the first that arrived", "published before this began", quiet=True
    ),
    **_counts(
        dropped="packets dropped because they came faster than they were taken",
        foreign="packets of a second publisher on the same key",
    ),
}
_WARNINGS = Field("{int}", "messages that were refused, by reason")
_RATE = {
    "events": Field("int", "events that were used"),
    "seconds": Field("number", "of the clock, compiling not included"),
    "events_per_s": Field("int", "events for each second of the clock", "events a second"),
}

RESULTS: dict[str, dict[str, Field]] = {
    "info": {
        "file": Field("text", "path or URL"),
        "topics": Field("[object]", "`name`, `schema`, `schema_encoding`, `messages` of each topic"),
        "read": Field("text", "the event topic that is read", "topic read"),
        "encoding": Field("text", "of its packets"),
        "resolution": Field("[int]", "height and width of the sensor, in pixels"),
        "other_resolutions": Field(
            "[object]",
            "`resolution` and `packets` of what has another: its own crop, or a change midway",
            "also",
        ),
        "events": Field("int", "events that can be used"),
        "on": Field("int", "ON events", "ON"),
        "off": Field("int", "OFF events", "OFF"),
        "rejected": Field(
            "int", "those of them that lie outside the resolution, and change nothing", quiet=True
        ),
        "first_us": Field(
            "int?", "stream time of the earliest event; null without events", "first event, us"
        ),
        "duration_s": Field("number", "from the earliest to the latest event", "duration, s"),
        "events_per_s": Field("int", "their ratio", "events a second"),
        "samples": Field("int", "labels", "labelled samples", quiet=True),
        "labels": Field("[text]", "names of the classes, sorted"),
        "splits": Field("[text]", "names of the splits, sorted"),
        "digest": Field("text", "SHA-256 of the decoded events"),
        **_DELIVERY,
        **_counts(
            jumps="steps ahead of the camera's clock",
            wraps="times that the camera's counter began again",
            steps_back="packets that begin before the one before them",
            lost="packets missing by their sequence numbers",
            stray_packets="packets whose times are of no use",
            stray_events="events whose times are of no use",
            out_of_order="messages behind the buffer of log times",
        ),
        "unread": Field("{int}", "chunks and packets that cannot be read, by reason"),
        "integrity": Field("text", "`intact` or `damaged`"),
        "removed": _REMOVED,
    },
    "info REC REC": {
        "recordings": Field(
            "[object]",
            "of each camera: `file`, `topic`, `encoding`, `resolution`, `events`, `duration_s`, `samples`, "
            "`digest`, `integrity`; or `file` and `error`",
        ),
    },
    "convert": {
        "written": _WRITTEN,
        "samples": Field("int?", "samples of a data set folder"),
        "events": Field("int", "events in the file"),
        "labels": Field("int?", "labels in the file, of one recording", quiet=True),
        "labels_left_out": Field(
            "int?", "labels that do not lie within the part, or that this format cannot hold", quiet=True
        ),
        "subtracted_us": Field("int?", "taken off every time, which the format could not hold", quiet=True),
        "bytes_in": Field("int?", "of the files of a data set"),
        "bytes_out": Field("int", "of the file"),
        "failed": Field("int?", "files of a data set that could not be read", quiet=True),
        "damaged": Field("int?", "files of a data set of which only a part could be read", quiet=True),
        "faults": Field("[object]", "`file`, `what` and `reason` of each"),
        "removed": _REMOVED,
    },
    "simulate": {
        "written": _WRITTEN,
        "samples": Field("int", "images that were simulated; 1 for a film"),
        "events": Field("int", "events in the file"),
        "bytes_out": Field("int", "of the file"),
        "failed": Field("int", "images that could not be read, or give no events", quiet=True),
        "damaged": Field("int", "frames or parts of a film that could not be read", quiet=True),
        "faults": Field("[object]", "`file`, `what` and `reason` of each"),
    },
    "label": {
        "labels": Field("text?", "the label file; null if nothing was labelled", "label file"),
        "samples": Field("int", "labels in it", "labels"),
        "seconds_by_class": Field("{number}", "how much of the recording each class has", "seconds"),
        "written": Field("text?", "the recording with labels, with --mcap"),
    },
    "learn": {
        "written": _WRITTEN,
        "formulation": Field("text", "`direct` or `inverse`"),
        "filters": Field("int", "filters, or atoms"),
        "features": Field("int", "numbers that an emission has", "numbers per emission"),
        "scales": Field("int", "scales whose features stand side by side", quiet=True),
        "volumes": Field("int", "local volumes that were learned from", "patches learned from"),
        "empty_share": Field(
            "number", "share of volumes without events, which were left out", "patches without events"
        ),
        "iterations": Field("int", "passes over them"),
        "objective": Field(
            "[number]", "objective at the first and at the last iteration", "error and penalty"
        ),
        "condition": Field("number", "condition number of the learned matrix; 1 is best", hidden=True),
        "coherence": Field("number", "largest likeness of two filters, 0 to 1", hidden=True),
        "unused": Field("int", "filters that no volume uses", quiet=True),
        "bytes": Field("int", "of the file"),
        "state": Field("text", "`narrow`, engines keep sums of 16 bits, or `wide`, of 32"),
        "wide_because": Field("text?", "why the state is not narrow", quiet=True),
        "log_determinant": Field(
            "text?", "with --rows free and fewer filters than entries: what it is taken of", hidden=True
        ),
    },
    "train": {
        "written": _WRITTEN,
        "selected_model": Field(
            "text?", "with --select: the model of the filters that were kept", quiet=True
        ),
        "labels": Field("[text]", "names of the classes"),
        "kernel": Field("text", "of the classifier that was written, `linear` or `rbf`"),
        "samples": Field("int", "samples that were trained on"),
        "C": Field("number", "regularisation that cross-validation chose"),
        "cross_validation": Field("number", "accuracy over its folds", "accuracy over folds"),
        "held_out_samples": Field("int?", "samples of splits named validation or test"),
        "held_out_accuracy": Field("number?", "accuracy on them"),
        "held_out_calibration_error": Field("number?", "how far probabilities are off"),
    },
    "replay": {
        **_RATE,
        "compile_seconds": Field("number", "compiling kernels before that", "compiling before"),
        "emissions": Field("int", "emissions of features"),
        "emit": Field("text", "when features were emitted"),
        **_SCORED,
        "unknown_labels": Field(
            "int", "samples that could not be learned from: the classifier lacks their label", quiet=True
        ),
        "dropped": Field("int", "0: a replay waits", quiet=True),
        **_UNUSED,
        "removed": _REMOVED,
        "saturated": Field("int", "events at pixels whose count was at its limit", hidden=True),
        "interrupted": _INTERRUPTED,
    },
    "view": {
        "seconds": Field("number", "of the clock"),
        "events": Field("int?", "events that were used; null without a model"),
        "packets": Field("int?", "packets of live topics"),
        "frames": Field("int", "pictures", "pictures"),
        "frames_skipped": Field("int", "pictures left out for lack of time", "pictures left out", quiet=True),
        "emissions": Field("int?", "emissions of features; null without a model"),
        **{name: Field(f"{field.kind.rstrip('?')}?", field.means) for name, field in _SCORED.items()},
        **{
            name: Field("int?", f"{field.means}; null where it is not counted", field.shown, quiet=True)
            for name, field in (_UNUSED | _DELIVERY | _ARRIVAL).items()
        },
        "interrupted": _INTERRUPTED,
    },
    "listen": {
        "seconds": Field("number", "of the clock"),
        "cameras": Field("int", "cameras that were served"),
        "packets": Field("int", "packets that were used"),
        "events": Field("int", "events that were used"),
        "events_per_s": Field("int", "events for each second of the clock", "events a second"),
        "emissions": Field("int", "emissions of features"),
        "incomplete": Field("int", "emissions of windows that packets are missing from", quiet=True),
        **_SCORED,
        **_UNUSED,
        **_DELIVERY,
        **_ARRIVAL,
        "other_shards_packets": Field("int?", "packets of cameras of other shards, with --shard"),
        **_counts(
            clock_restarts="cameras' clocks that started anew",
            clock_jumps="cameras' clocks that jumped ahead by more than a minute",
            clock_wraps="cameras' clocks that wrapped, which is undone",
            stray_packets="packets with absurd times, which were left out",
            stray_events="events with absurd times, which were left out",
        ),
        "warnings": _WARNINGS,
        "end_to_end_p50_ms": Field("number?", "publication to features, median", "latency p50, ms"),
        "end_to_end_p99_ms": Field("number?", "the same, 99th percentile", "latency p99, ms"),
        "interrupted": _INTERRUPTED,
    },
    "listen --cluster": {
        "cameras": Field("int", "cameras that were served"),
        "packets": Field("int", "packets that were used"),
        "events": Field("int", "events that were used"),
        "emissions": Field("int", "emissions of features"),
        "samples": _SCORED["samples"],
        "lost": _UNUSED["lost"],
        "dropped": _ARRIVAL["dropped"],
        "incomplete": Field("int", "emissions of windows that packets are missing from", quiet=True),
        "missed": Field("int", "packets between one worker and the next", quiet=True),
        "unheard": _ARRIVAL["unheard"],
        "restarts": Field("int", "workers that took a camera over", quiet=True),
        "interrupted": _INTERRUPTED,
        "of_each": Field(
            "object", "the same of each camera, with its `worker` and its `starts`", hidden=True
        ),
    },
    "publish": {
        "topics": Field("[text]", "keys that were published on"),
        "packets": Field("int", "packets"),
        "events": Field("int", "events in them"),
        "bytes": Field("int", "bytes in them"),
        "seconds": Field("number", "of the clock"),
        "events_per_s": Field("int", "events for each second of the clock", "events a second"),
        "interrupted": _INTERRUPTED,
    },
    "record": {
        "written": _WRITTEN,
        "topics": Field("[text]", "topics in it, sorted"),
        "messages": Field("int", "messages in it"),
        "bytes": Field("int", "bytes in them"),
        "seconds": Field("number", "of the clock"),
        **_counts(lost="packets that never arrived"),
        "unheard": _ARRIVAL["unheard"],
        "dropped": _ARRIVAL["dropped"],
        "duplicates": _DELIVERY["duplicates"],
        "restarts": _DELIVERY["restarts"],
        "warnings": _WARNINGS,
        "interrupted": _INTERRUPTED,
    },
    "recover": {
        "written": _WRITTEN,
        "lost": Field("int", "pieces that could not be read"),
        "reasons": Field("{int}", "the same by reason"),
    },
    "topics": {
        "topics": Field(
            "[object]",
            "of each topic `name`, `kind` (`zenoh`, `ros2`), `domain`, `publishers`, `type`, `encoding`, "
            "`resolution` (null where nothing was sent), `rate_hz`, `bytes_per_s`",
        ),
    },
    "demo": {
        "written": Field("text", "the folder that was written to"),
        "simulated": Field("int", "events that were simulated"),
        "features": Field("int", "numbers that an emission has"),
        "events": Field("int", "events that were replayed"),
        "emissions": Field("int", "emissions of features"),
        **_SCORED,
        "seconds": Field("number", "of the clock, in all"),
        "next": Field("[text]", "commands to try next"),
    },
    "evaluate": {
        "recordings": Field("[text]", "names of the files"),
        "labels": Field("[text]", "names of the classes"),
        "samples": Field("object", "`training` and `held_out`: how many"),
        "split": Field("text", "what was scored"),
        "interval": Field("text", "what `low` and `high` of a row are"),
        "leakage": Field("object?", "accuracy of a nearest neighbour, by random and by block folds"),
        "rows": Field("[object]", "one for each method and setting: `accuracy`, `low`, `high` and more"),
        "published": Field("object", "figures of the paper"),
        "machine": Field("object", "processor and versions"),
    },
    "latency": {
        "recording": Field("text", "path or URL"),
        "machine": Field("object", "processor and versions"),
        "clock_ns": Field("number", "what the kernels' clock costs; not subtracted"),
        "python_clock_ns": Field("number", "what Python's clock costs"),
        "steal_share": Field("number?", "processor time that other virtual machines took; null if unknown"),
        "preemptions": Field("int?", "times that the process was put aside"),
        "warm_up_events": Field("int", "events before any was counted"),
        "limit_events": Field("int", "events that were counted, at most"),
        "seconds": Field("number", "for each measurement, at most"),
        "speed": Field("number", "pace of end to end"),
        "look_ahead": Field("bool", "whether bin boundaries were prepared beforehand"),
        "threads": Field("int", "threads that emissions are computed on"),
        "interrupted": _INTERRUPTED,
        "models": Field("[object]", "what each model is"),
        "rows": Field("[object]", "percentiles in nanoseconds for each `model`, `emit` and `what`"),
    },
    "doctor": {
        "machine": Field("object", "processor, system and versions"),
        "cpu_features": Field("[text]", "what the processor has, as LLVM names it"),
        "vectors": Field("[text]", "vector instructions"),
        "threads": Field("object", "of numba: `numba`, `layer`"),
        "required": Field("object", "`installed` and `wanted` of each dependency"),
        "extras": Field("object", "`for` and `missing` of each extra"),
        "kernels": Field("object", "`folder`, `cached`, `first_use_s`"),
        "exact": Field("bool", "whether stream and offline features have the same bits"),
        "speed": Field("object", "a second of work"),
        "problems": Field("[text]", "what keeps streamfeat from working as it should"),
    },
}
"""The result of each command that takes --json: its fields in order."""
