"""Train a network of PyTorch on features, a batch at a time.

    pip install torch
    python tools/examples/torch_dataloader.py

Lives here: `EventFeatures` behind a `DataLoader`; a batch is encoded when it is asked for, on all cores.
Not here: networks that look at events themselves.
"""

from pathlib import Path

import torch
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from torch.utils.data import DataLoader, Dataset

import streamfeat as sf
from streamfeat.classify.classifier import normalise_features
from streamfeat.recordings.reader import Sample

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"


class Features(Dataset):
    """Labelled samples as pairs of features and class."""

    def __init__(self, samples: list[Sample], steps: Pipeline) -> None:
        self.samples, self.steps = samples, steps
        self.classes = sorted({sample.label.label for sample in samples})

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, i: int) -> tuple[torch.Tensor, int]:
        return self.__getitems__([i])[0]

    def __getitems__(self, indices: list[int]) -> list[tuple[torch.Tensor, int]]:
        """A whole batch at once, which `DataLoader` asks for where it can."""
        samples = [self.samples[i] for i in indices]
        rows = torch.from_numpy(self.steps.transform(samples))
        return [
            (row, self.classes.index(sample.label.label)) for row, sample in zip(rows, samples, strict=True)
        ]


def main(epochs: int = 5) -> float:
    torch.manual_seed(0)
    encoder = sf.Encoder.load(RECORDINGS / "digits.safetensors")
    samples = {}
    for split in ("train", "test"):
        with sf.open_recording(RECORDINGS / f"digits_{split}.mcap") as recording:
            samples[split] = list(recording.samples())
    steps = make_pipeline(
        sf.EventFeatures(encoder), FunctionTransformer(normalise_features), StandardScaler()
    ).fit(samples["train"])
    data = {split: Features(part, steps) for split, part in samples.items()}

    network = torch.nn.Linear(encoder.n_features, len(data["train"].classes))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    for epoch in range(epochs):
        for features, labels in DataLoader(data["train"], batch_size=32, shuffle=True):
            optimiser.zero_grad()
            loss = torch.nn.functional.cross_entropy(network(features), labels)
            loss.backward()
            optimiser.step()
        print(f"epoch {epoch}: loss {loss.item():.3f}")

    right = sum(
        int((network(features).argmax(1) == labels).sum())
        for features, labels in DataLoader(data["test"], batch_size=50)
    )
    print(f"{right} of {len(data['test'])} right")
    return right / len(data["test"])


if __name__ == "__main__":
    main()
