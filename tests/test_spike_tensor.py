"""EST: the tensor, its learned kernel, and what is said where PyTorch is not there."""

import importlib.util
import json

import numpy as np
import pytest
import tiny
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE
from streamfeat.recordings.reader import open_recording

with_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="the extra deep is not installed"
)
SMALL = {"epochs": 3, "bins": 3, "grid": 8, "channels": (6, 8)}


@pytest.fixture(scope="module")
def animals(tmp_path_factory):
    return tiny.write_items(tmp_path_factory.mktemp("est") / "animals.mcap", tiny.labelled_items(18))


def trained(path, **options):
    from streamfeat.evaluate.spike_tensor import SpikeTensor

    with open_recording(path) as recording:
        return SpikeTensor.fitted([recording], **SMALL | options)


def test_without_pytorch_it_is_one_line_before_anything_is_read(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "torch" else find(name))
    result = CliRunner().invoke(cli.app, ["evaluate", str(tmp_path / "none.mcap"), "--method", "est"])
    assert isinstance(result.exception, InputError)
    assert str(result.exception) == (
        "--method est needs torch, which is not there: pip install 'streamfeat[deep]'"
    )


@with_torch
def test_the_kernel_begins_trilinear():
    import torch

    from streamfeat.evaluate.spike_tensor import STEPS, _one_thread, _trilinear, kernel_table

    with _one_thread(0):
        kernel = _trilinear(3)
    table = kernel_table(kernel, 3).detach().numpy()
    assert table.shape == (3, 2 * STEPS + 1)
    time = np.linspace(0, 1, 2 * STEPS + 1)
    wanted = time * np.maximum(0, 1 - 2 * np.abs(time - np.array([[0], [0.5], [1]])))
    assert np.abs(table - wanted).max() < 0.1
    assert torch.get_num_threads() >= 1


@with_torch
def test_the_tensor_is_the_sum_over_events():
    from streamfeat.evaluate.spike_tensor import STEPS, kernel_table, spike_steps

    made = trained_once()
    x, y, p, t = np.array([0, 15, 7]), np.array([0, 11, 6]), np.array([0, 1, 1]), np.array([0, 40, 100])
    steps = spike_steps(x, y, p, t, (12, 16), 3, 8)
    tensor = made._tensor(made._counts(steps)[None]).detach().numpy()[0]
    table = kernel_table(made.parts[0], 3).detach().numpy()
    wanted = np.zeros((2, 3, 8, 8))
    for xi, yi, pi, ti in zip(x, y, p, t, strict=True):
        wanted[pi, :, yi * 8 // 12, xi * 8 // 16] += table[:, round(ti / 100 * 2 * STEPS)]
    wanted = np.sign(wanted) * np.log1p(np.abs(wanted))
    np.testing.assert_allclose(tensor, wanted.reshape(6, 8, 8), atol=1e-6)


_ONCE = []


def trained_once():
    """A network that has seen nothing of use."""
    if not _ONCE:
        from streamfeat.evaluate import spike_tensor

        kernel = spike_tensor._trilinear(3)
        body, n = spike_tensor._body(3, (6, 8))
        _ONCE.append(spike_tensor.SpikeTensor((kernel, body.eval(), None), n, bins=3, grid=8))
    return _ONCE[0]


@with_torch
def test_a_seed_gives_the_same_network_and_another_seed_another(animals):
    told = []
    first = trained(animals, report=lambda *step: told.append(step))
    assert [step[:3] for step in told] == [("training est", i, 3) for i in (1, 2, 3)]
    assert first.fingerprint == trained(animals).fingerprint
    assert first.fingerprint != trained(animals, seed=1).fingerprint
    before = [weight.detach().numpy().copy() for weight in trained(animals, epochs=1).parts[0].parameters()]
    after = [weight.detach().numpy() for weight in first.parts[0].parameters()]
    assert not all(map(np.array_equal, before, after))  # the kernel learns, too


@with_torch
def test_of_many_samples_some_are_drawn_by_the_seed(animals, monkeypatch):
    from streamfeat.evaluate import spike_tensor

    monkeypatch.setattr(spike_tensor, "_MOST_SAMPLES", 7)
    steps, seen = spike_tensor.spike_steps, []
    monkeypatch.setattr(spike_tensor, "spike_steps", lambda *a: seen.append(a[3].sum()) or steps(*a))
    drawn = []
    for seed in (0, 0, 1):
        seen.clear()
        trained(animals, epochs=1, seed=seed)
        drawn.append([*seen])
    assert [len(one) for one in drawn] == [7, 7, 7]
    assert drawn[0] == drawn[1] != drawn[2]


@with_torch
def test_features_of_a_window(animals):
    made = trained_once()
    events = tiny.steady(1000, 90_000, 300)
    rows = made.encode(events[events["t"] <= 50_000], tiny.RESOLUTION, origin_us=1000)
    assert (rows.shape, rows.dtype) == ((made.n_features,), np.float32)
    cut = made.encode(events, tiny.RESOLUTION, origin_us=1000, t_us=50_000)
    np.testing.assert_array_equal(cut, rows)
    assert np.isfinite(made.encode(np.zeros(0, EVENT_DTYPE), tiny.RESOLUTION)).all()


@with_torch
def test_one_label_is_nothing_to_learn(tmp_path):
    path = tiny.write_items(tmp_path / "cats.mcap", tiny.labelled_items(3, names=("cat",)))
    with pytest.raises(InputError, match="est has nothing to learn"):
        trained(path)


@with_torch
def test_it_is_evaluated_as_every_method(animals, monkeypatch):
    from streamfeat.evaluate.spike_tensor import SpikeTensor

    fitted = SpikeTensor.fitted
    monkeypatch.setattr(SpikeTensor, "fitted", lambda *a, **k: fitted(*a, **k | SMALL))
    arguments = [str(animals), "--method", "est", "--folds", "2", "--downsample", "2", "--early-samples", "0"]
    result = CliRunner().invoke(cli.app, ["evaluate", *arguments, "--json"])
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)["rows"]
    assert (row["method"], row["features"], row["setting"]["downsample"]) == ("est", 32, 2)
