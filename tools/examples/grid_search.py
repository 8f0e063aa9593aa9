"""Search over encoders and classifiers at once, with scikit-learn.

    python tools/examples/grid_search.py

Lives here: `EventFeatures` as a step of a pipeline, and models that are learned beforehand.
Not here: comparing many methods (`streamfeat evaluate`).
"""

import tempfile
from pathlib import Path

from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

import streamfeat as sf
from streamfeat.classify.classifier import normalise_features
from streamfeat.classify.svm import LinearSVM
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting

RECORDING = Path(__file__).resolve().parents[2] / "recordings" / "digits_train.mcap"


def main(n_samples: int = 120) -> float:
    encoders = []
    with sf.open_recording(RECORDING) as recording:
        samples = list(recording.samples())[:n_samples]
        for patch in (4, 8):
            size = {"patch": patch, "stride": 4, "max_count": 2, "filters": 16}
            # So few filters have few large codes: lower thresholds than the defaults, which are for 400.
            setting = Setting(**size, lambda0=0.5, threshold=0.5, volumes=1_000, iterations=3)
            encoders.append(learn_encoder([recording], setting))

    # Features of each encoder and fold are kept, so that values of C cost next to nothing.
    with tempfile.TemporaryDirectory() as memory:
        steps = [
            ("features", sf.EventFeatures(encoders[0])),
            ("normalise", FunctionTransformer(normalise_features)),
            ("scale", StandardScaler()),
            ("svm", LinearSVM()),
        ]
        grid = {"features__encoder": encoders, "svm__C": [1e-5, 1e-4, 1e-3]}
        search = GridSearchCV(Pipeline(steps, memory=memory), grid, cv=3)
        search.fit(samples, [sample.label.label for sample in samples])
    best = search.best_params_
    print(f"patch {best['features__encoder'].geometry.patch}, C {best['svm__C']}: {search.best_score_:.3f}")
    return float(search.best_score_)


if __name__ == "__main__":
    main()
