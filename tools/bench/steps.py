"""One online learning step of a linear classifier, and one prediction.

Lives here: the part `learning`. Not here: how well they learn.
"""

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import SGDClassifier
from threadpoolctl import threadpool_limits

import streamfeat as sf
from tools.bench.material import Setting, encoder_of_volumes
from tools.bench.timing import Contestant, race

__all__ = ["measure_learning"]

BATCH = 16


def measure_learning(setting: Setting) -> dict[str, Any]:
    """Nanoseconds a sample of one step, on pooled features of real samples."""
    geometry = setting.geometry(stride=12)
    encoder = encoder_of_volumes(setting.material, geometry, setting.n_filters)
    samples = setting.material.fitting(geometry.patch)[:BATCH]
    features = np.stack(
        [
            encoder.encode(
                sample.events,
                sample.resolution,
                origin_us=sample.label.start_us,
                t_us=sample.label.start_us + geometry.window_us - 1,
            )
            for sample in samples
        ]
    )
    labels = [("a", "b")[i % 2] for i in range(len(features))]
    start = sf.Classifier.untrained(labels, encoder)
    contestants = {
        "ours, batches of 1": _ours(sf.OnlineClassifier(start, batch_size=1), features, labels),
        f"ours, batches of {BATCH}": _ours(
            sf.OnlineClassifier(start, batch_size=len(labels)), features, labels
        ),
        "ours, predict_one": _ours_predicting(sf.OnlineClassifier(start), features),
    } | _scikit(start.prepare(features), labels)
    missing = []
    if importlib.util.find_spec("river"):
        contestants |= _river(start.prepare(features), labels)
    else:
        missing.append("river")
    setting.say(f"{features.shape[1]} features")
    with threadpool_limits(1):
        result = race(contestants, setting.rounds(10))
    ours = f"ours, batches of {BATCH}"
    others = [name for name in contestants if not name.startswith("ours")]
    return {
        "features": features.shape[1],
        "race": result.figures(),
        "over_ours": {name: result.ratio(name, ours) for name in others},
        "missing": missing,
    }


def _ours(model: sf.OnlineClassifier, features: NDArray[np.float32], labels: list[str]) -> Contestant:
    def learn() -> None:
        for row, label in zip(features, labels, strict=True):
            model.learn_one(row, label)

    return Contestant(learn, len(labels))


def _ours_predicting(model: sf.OnlineClassifier, features: NDArray[np.float32]) -> Contestant:
    return Contestant(lambda: [model.predict_one(row) for row in features], len(features))


def _scikit(rows: NDArray[np.float32], labels: list[str]) -> dict[str, Contestant]:
    def make() -> SGDClassifier:
        return SGDClassifier(loss="hinge", penalty=None, learning_rate="pa1", eta0=0.01)

    wide, classes = rows.astype(np.float64), sorted(set(labels))
    single, whole = make(), make()

    def one_by_one() -> None:
        for i, label in enumerate(labels):
            single.partial_fit(wide[i : i + 1], [label], classes)

    return {
        "scikit-learn partial_fit, 1 sample": Contestant(one_by_one, len(labels)),
        f"scikit-learn partial_fit, {BATCH} samples": Contestant(
            lambda: whole.partial_fit(wide, labels, classes), len(labels)
        ),
    }


def _river(rows: NDArray[np.float32], labels: list[str]) -> dict[str, Contestant]:
    from river import linear_model, optim

    dictionaries = [dict(enumerate(row.tolist())) for row in rows]
    targets = [label == "a" for label in labels]
    passive = linear_model.PAClassifier(C=0.01, mode=1)
    logistic = linear_model.LogisticRegression(optimizer=optim.SGD(0.01), loss=optim.losses.Hinge())

    def learn(model: Any) -> Any:
        def steps() -> None:
            for row, target in zip(dictionaries, targets, strict=True):
                model.learn_one(row, target)

        return steps

    contestants = {
        "river PAClassifier.learn_one": Contestant(learn(passive), len(targets)),
        "river linear model, hinge, learn_one": Contestant(learn(logistic), len(targets)),
    }
    if importlib.util.find_spec("pandas"):
        import pandas

        frame, column = pandas.DataFrame(rows), pandas.Series(targets)
        frame.columns = [str(name) for name in frame.columns]
        many = linear_model.LogisticRegression(optimizer=optim.SGD(0.01), loss=optim.losses.Hinge())
        contestants[f"river linear model, hinge, learn_many of {BATCH}"] = Contestant(
            lambda: many.learn_many(frame, column), len(targets)
        )
    return contestants
