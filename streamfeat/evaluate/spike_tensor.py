"""EST, the event spike tensor: a learned kernel on the times of events, before a convolutional network.

Lives here: the tensor, the network, its training, and the map from events to features that is left of both.
Not here: how the method is chosen (`methods`). This module needs PyTorch, the extra `deep`.
"""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.samples import downsampled, some_training_samples, until
from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import Recording

with suppress(ImportError):  # where it is not there `methods.needs` says so before any of this is called
    import torch
    from torch import nn

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["SpikeTensor", "kernel_table", "spike_steps"]

STEPS = 8
"""Steps of time between two bins, at which the learned kernel is evaluated."""

_MOST_EVENTS = 30_000
"""Of a sample, evenly drawn: what a sample may take of memory and time."""

_MOST_SAMPLES = 20_000
"""To learn from."""

_BATCH = 16
_HIDDEN = 30
_KERNEL_PASSES = 300

Report = Callable[[str, int, int, str], None]


@dataclass(frozen=True, slots=True, eq=False)
class SpikeTensor:
    """EST (Gehrig, Loquercio, Derpanis and Scaramuzza 2019, "End-to-End Learning of Representations for
    Asynchronous Event-Based Data", ICCV), and a small network trained with it from nothing.

    As there, each event puts its normalised time `t` (their measurement `f = t`, section 3.2), weighted by a
    kernel `k(t - c / (C - 1))`, into each bin `c` of its pixel and polarity (equation 5); `k` is a
    perceptron of two hidden layers of 30 units that begins as the trilinear kernel and is trained with all
    else. Deviations:

    - the network is three small convolutions trained from nothing on the training samples alone, in place of
      a ResNet-34 that had seen ImageNet: the published accuracy cannot be expected of it;
    - times are rounded to an eighth of a bin, so that `k` is evaluated once for each step and not for each
      event;
    - samples are stretched to a grid of 64x64 pixels, where theirs are cropped and resized to 224x224;
    - of a sample with more than 30,000 events every n-th counts;
    - what the layer before the last one gives for a sample are its features, and the same classifier as every
      method's is trained on them.

    Attributes:
        parts: the kernel, the layers that make features, and the last one, in torch.
        n_features: length of a feature vector.
        downsample: sensor pixels along each side of one that is counted as one.
        bins: of the tensor, `C`.
        grid: rows and columns of the tensor.
    """

    parts: tuple[Any, Any, Any]
    n_features: int
    downsample: int = 1
    bins: int = 9
    grid: int = 64

    @classmethod
    def fitted(
        cls,
        recordings: Sequence[Recording],
        *,
        downsample: int = 1,
        seed: int = 0,
        epochs: int = 30,
        bins: int = 9,
        grid: int = 64,
        channels: tuple[int, ...] = (32, 64, 128),
        report: Report = lambda step, done, total, remark: None,
    ) -> "SpikeTensor":
        """Train kernel and network on the samples that are not held out, with their labels; on one thread.

        The same seed and samples give the same network on the same machine.

        Args:
            recordings: open recordings.
            downsample: sensor pixels along each side of one that is counted as one.
            seed: of weights, order and shifts.
            epochs: passes over the samples.
            bins: of the tensor.
            grid: rows and columns of the tensor.
            channels: of the convolutional layers, each of which halves the grid.
            report: told about progress.

        Raises:
            InputError: there is no event, or there are fewer than two classes.
        """
        steps, labels = [], []
        _, samples = some_training_samples(recordings, _MOST_SAMPLES, np.random.default_rng([seed, 1]))
        for sample in samples:
            small, resolution = downsampled(sample.events, sample.resolution, downsample)
            steps.append(spike_steps(*until(small, resolution), resolution, bins, grid))
            labels.append(sample.label.label)
        names = sorted(set(labels))
        if len(names) < 2 or not sum(map(len, steps)):
            raise InputError(
                "the training samples have no events or only one label; est has nothing to learn"
            )
        targets = torch.tensor([names.index(label) for label in labels])
        with _one_thread(seed):
            kernel = _trilinear(bins)
            body, n_features = _body(bins, channels)
            head = nn.Linear(n_features, len(names))
            made = cls((kernel, body, head), n_features, downsample, bins, grid)
            made._train(steps, targets, epochs, np.random.default_rng(seed), report)
        for part in made.parts:
            part.eval()
        return made

    def _train(
        self,
        steps: Sequence[NDArray[np.int32]],
        targets: Any,
        epochs: int,
        rng: np.random.Generator,
        report: Report,
    ) -> None:
        weights = [weight for part in self.parts for weight in part.parameters()]
        batches = -(-len(steps) // _BATCH)
        optimiser = torch.optim.AdamW(weights, lr=1e-3, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=epochs * batches)
        for epoch in range(epochs):
            order, losses = rng.permutation(len(steps)), []
            for some in np.array_split(order, batches):
                counts = torch.stack([self._counts(steps[i]) for i in some])
                shift = rng.integers(-3, 4, 2).tolist()
                tensor = torch.roll(self._tensor(counts), shift, dims=(2, 3))
                given = self.parts[2](self.parts[1](tensor))
                loss = nn.functional.cross_entropy(given, targets[some], label_smoothing=0.1)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
                losses.append(float(loss.detach()))
            report("training est", epoch + 1, epochs, f"loss {np.mean(losses):.3f}")

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        found = hashlib.sha256(repr((self.downsample, self.bins, self.grid)).encode())
        for part in self.parts[:2]:
            for name, value in part.state_dict().items():
                found.update(name.encode() + value.numpy().tobytes())
        return found.hexdigest()

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        small, resolution = downsampled(events, resolution, self.downsample)
        columns = until(small, resolution, origin_us, t_us)
        steps = spike_steps(*columns, resolution, self.bins, self.grid)
        with torch.no_grad():
            given = self.parts[1](self._tensor(self._counts(steps)[None]))
        features: NDArray[np.float32] = given[0].numpy()
        return features

    def _counts(self, steps: NDArray[np.int32]) -> Any:
        """`(2, steps, grid^2)` float32, events of each polarity, step of time and place."""
        n_steps = STEPS * (self.bins - 1) + 1
        counts = np.bincount(steps, minlength=2 * n_steps * self.grid**2).astype(np.float32)
        return torch.from_numpy(counts.reshape(2, n_steps, self.grid**2))

    def _tensor(self, counts: Any) -> Any:
        """The event spike tensor `(n, 2 C, grid, grid)` of counts `(n, 2, steps, grid^2)`."""
        values = kernel_table(self.parts[0], self.bins) @ counts
        # Counts of events have a long tail, and networks of this size train badly on it.
        values = torch.sign(values) * torch.log1p(torch.abs(values))
        return values.reshape(len(counts), 2 * self.bins, self.grid, self.grid)


def spike_steps(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    p: NDArray[np.int64],
    t: NDArray[np.int64],
    resolution: Resolution,
    bins: int,
    grid: int,
) -> NDArray[np.int32]:
    """The flat place `(polarity, step of time, row, column)` of each event, `(n,)` int32.

    Time runs from 0 at the origin to 1 at the last event, in `STEPS` steps between two bins.
    """
    every = max(1, -(-len(t) // _MOST_EVENTS))
    x, y, p, t = x[::every], y[::every], p[::every], t[::every]
    last = STEPS * (bins - 1)
    step = np.rint(t / max(int(t[-1]), 1) * last).astype(np.int64) if len(t) else t
    place = y * grid // resolution[0] * grid + x * grid // resolution[1]
    return ((p * (last + 1) + step) * grid**2 + place).astype(np.int32)


def kernel_table(kernel: Any, bins: int) -> Any:
    """`(bins, steps)` float32: `t k(t - c / (C - 1))`, what an event at each step puts into each bin."""
    time = torch.linspace(0, 1, STEPS * (bins - 1) + 1)
    centres = torch.linspace(0, 1, bins)
    away = time[None, :] - centres[:, None]
    return time * kernel(away.reshape(-1, 1)).reshape(away.shape)


def _trilinear(bins: int) -> Any:
    """A perceptron that is `max(0, 1 - (C - 1) |t|)` to begin with."""
    kernel = nn.Sequential(
        nn.Linear(1, _HIDDEN),
        nn.LeakyReLU(0.1),
        nn.Linear(_HIDDEN, _HIDDEN),
        nn.LeakyReLU(0.1),
        nn.Linear(_HIDDEN, 1),
    )
    time = torch.linspace(-1, 1, 2 * STEPS * (bins - 1) + 1).reshape(-1, 1)
    wanted = torch.clamp(1 - (bins - 1) * torch.abs(time), min=0)
    optimiser = torch.optim.Adam(kernel.parameters(), lr=1e-2)
    for _ in range(_KERNEL_PASSES):
        optimiser.zero_grad()
        nn.functional.mse_loss(kernel(time), wanted).backward()
        optimiser.step()
    return kernel


def _body(bins: int, channels: Sequence[int]) -> tuple[Any, int]:
    """Convolutions that each halve the grid, averaged over quadrants, and how many numbers come out."""
    layers: list[Any] = []
    before = 2 * bins
    for n in channels:
        layers += [
            nn.Conv2d(before, n, 3, stride=2, padding=1, bias=False),
            nn.BatchNorm2d(n),
            nn.ReLU(),
        ]
        before = n
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(2), nn.Flatten()), 4 * channels[-1]


@contextmanager
def _one_thread(seed: int) -> "Iterator[None]":
    """Random numbers of this seed, and one thread, as long as it lasts."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)
