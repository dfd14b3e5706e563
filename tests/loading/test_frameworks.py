"""A dataset, and a mixture of several, is what torch's and Grain's own loaders take as it is."""

import importlib
import pickle
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.loading import dataset as loader

FIELDS = ("index", "frames", "states/*")


@pytest.fixture(scope="module", params=["dataset", "mixture"])
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A map-style source of 20 videos."""
    root = synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")).root
    dataset = loader.open(root, "train", FIELDS)
    return dataset if request.param == "dataset" else gen2d.mix({"one": dataset, "other": dataset})


def check(batches: Sequence[dict[str, Any]], source: Any, order: Sequence[int]) -> None:
    """Fails unless the batches hold the videos at these positions, to the bit."""
    for name, values in source[np.asarray(order)].items():
        actual = np.concatenate([np.asarray(batch[name]) for batch in batches])
        assert actual.dtype == values.dtype
        assert_array_equal(actual, values)


# ---- torch


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # more than this process has cores
@pytest.mark.parametrize("method", [None, "fork", "spawn"])
def test_torch_reads_the_same_in_any_number_of_processes(source: Any, method: str | None) -> None:
    torch = package("torch")
    workers = {"num_workers": 2, "multiprocessing_context": method} if method else {"num_workers": 0}
    batches = list(torch.utils.data.DataLoader(source, batch_size=6, **workers))
    assert [len(batch["index"]) for batch in batches] == [6] * (len(source) // 6) + [len(source) % 6]
    assert all(isinstance(values, torch.Tensor) for batch in batches for values in batch.values())
    check(batches, source, range(len(source)))


def test_torch_asks_for_whole_batches(source: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = package("torch")
    requests: list[list[int]] = []
    whole = type(source).__getitems__
    monkeypatch.setattr(
        type(source), "__getitems__", lambda self, indices: requests.append(list(indices)) or whole(self, indices)
    )
    generator = torch.Generator().manual_seed(0)
    batches = list(torch.utils.data.DataLoader(source, batch_size=5, shuffle=True, generator=generator))
    order = [number for batch in requests for number in batch]
    assert [len(batch) for batch in requests] == [5] * (len(source) // 5)
    assert sorted(order) == list(range(len(source)))
    check(batches, source, order)


# ---- Grain


def test_grain_shuffles_and_batches(source: Any) -> None:
    package("grain")
    grain = importlib.import_module("grain.python")
    plain = grain.MapDataset.source(source)
    assert len(plain) == len(source)
    check(list(plain.batch(4)), source, range(len(source)))
    numbers = grain.MapDataset.source(np.arange(len(source))).seed(7).shuffle()
    batches = list(plain.seed(7).shuffle().batch(4))
    check(batches, source, [int(numbers[place]) for place in range(len(source))])
    assert sorted(int(numbers[place]) for place in range(len(source))) == list(range(len(source)))


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """20 videos with random windows of 2 of 5 frames."""
    root = synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("data") / "toy")).root
    return loader.open(root, "train", FIELDS, window=2)


def same(batches: Any, expected: Any) -> None:
    """Fails unless the batches have the same fields, types and bits."""
    for batch, other in zip(batches, expected, strict=True):
        assert batch.keys() == other.keys()
        for name, values in other.items():
            assert np.asarray(batch[name]).dtype == values.dtype
            assert_array_equal(np.asarray(batch[name]), values)


@pytest.mark.parametrize("shuffle", [True, False])
def test_a_source_for_grain_has_the_batches_of_gen2d(windows: Any, shuffle: bool) -> None:
    for ds in (windows, gen2d.mix({"one": windows, "other": windows})):
        source = gen2d.grain.source(ds, seed=3, shuffle=shuffle, epochs=3)
        assert len(source) == 3 * len(ds)
        expected = list(gen2d.DataLoader(ds, 5, seed=3, shuffle=shuffle, epochs=3))
        videos = [source[index] for index in range(len(source))]
        same(
            [{name: values[None] for name, values in source[-1].items()}],
            [{k: v[-1:] for k, v in expected[-1].items()}],
        )
        same([pickle.loads(pickle.dumps(source))[len(source) - 1]], [videos[-1]])
        batches = [videos[first : first + 5] for first in range(0, len(videos), 5)]
        same([{name: np.stack([video[name] for video in batch]) for name in batch[0]} for batch in batches], expected)
        endless = gen2d.grain.source(ds, seed=3, shuffle=shuffle, epochs=None)
        same([endless[len(source) - 1]], [videos[-1]])
        assert len(endless) == sys.maxsize
    with pytest.raises(IndexError, match="index 60 is not there: 3 epochs have 60 videos"):
        gen2d.grain.source(windows, epochs=3)[60]


@pytest.mark.parametrize("workers", [0, 2])
def test_grain_gives_random_windows_and_resumes(windows: Any, workers: int) -> None:
    package("grain")
    grain = importlib.import_module("grain.python")
    expected = list(gen2d.DataLoader(windows, 5, seed=3, epochs=2))
    source = gen2d.grain.source(windows, seed=3, epochs=2)
    if workers:
        importlib.import_module("absl.flags").FLAGS.mark_as_parsed()
        order = grain.IndexSampler(len(source), shuffle=False, num_epochs=1, seed=0)
        batches = grain.DataLoader(data_source=source, sampler=order, operations=[grain.Batch(5)], worker_count=2)
        videos = {(int(i), *starts) for b in batches for i, *starts in zip(b["index"], b["window/start"], strict=True)}
        assert videos == {
            (int(i), int(start)) for b in expected for i, start in zip(b["index"], b["window/start"], strict=True)
        }
        return
    batches = grain.MapDataset.source(source).batch(5).to_iter_dataset()
    iterator = iter(batches)
    same([next(iterator) for _ in range(3)], expected[:3])
    state, iterator = iterator.get_state(), iter(batches)
    iterator.set_state(state)
    same(iterator, expected[3:])


@pytest.mark.parametrize("workers", [0, 2])
def test_grains_own_loader_reads_the_same(source: Any, workers: int) -> None:
    package("grain")
    grain = importlib.import_module("grain.python")
    importlib.import_module("absl.flags").FLAGS.mark_as_parsed()  # as absl.app does; Grain asks them for its workers
    sampler = grain.IndexSampler(len(source), shuffle=False, num_epochs=1, seed=0)
    loading = grain.DataLoader(data_source=source, sampler=sampler, operations=[grain.Batch(5)], worker_count=workers)
    batches = list(loading)
    order = [int(number) for batch in batches for number in batch["index"]]
    assert sorted(order) == sorted(source[:]["index"].tolist())
    if workers == 0:
        check(batches, source, range(len(source)))


# ---- tf.data


def test_tf_data_reads_from_a_generator(windows: Any) -> None:
    tf = package("tensorflow")
    ds = windows
    batches = gen2d.DataLoader(ds, 5, seed=3, epochs=2)
    signature = {name: tf.TensorSpec((None, *values.shape[1:]), values.dtype) for name, values in ds.empty(0).items()}
    data = tf.data.Dataset.from_generator(lambda: batches, output_signature=signature).prefetch(2)
    same(data.as_numpy_iterator(), list(gen2d.DataLoader(ds, 5, seed=3, epochs=2)))


@pytest.mark.filterwarnings("ignore")
def test_tensorflow_datasets_keeps_a_copy_of_every_bit(tmp_path: Any) -> None:
    tfds = package("tensorflow_datasets")
    root = synthetic.make(synthetic.dataset(tmp_path / "toy")).root
    ds = loader.open(root, "train", FIELDS)
    features = {name: tfds.features.Tensor(shape=own.shape[1:], dtype=own.dtype) for name, own in ds.empty(0).items()}
    tfds.dataset_builders.store_as_tfds_dataset(
        name="toy",
        version="1.0.0",
        features=tfds.features.FeaturesDict(features),
        split_datasets={"train": enumerate(ds)},
        data_dir=tmp_path / "tfds",
    )
    found = sorted(
        tfds.as_numpy(tfds.load("toy", split="train", data_dir=tmp_path / "tfds")),
        key=lambda video: int(video["index"]),
    )
    same(found, list(ds))


# ---- Lightning and Accelerate


class Reader:
    """Video and window of every training step, by epoch."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, tuple[int, ...], tuple[int, ...]]] = []

    def read(self, epoch: int, batch: dict[str, Any]) -> None:
        self.steps.append((epoch, tuple(batch["index"].tolist()), tuple(batch["window/start"].tolist())))


def expected_steps(windows: Any, epochs: int) -> list[Any]:
    """What three epochs of batches of 5 read, by index, without any loader."""
    data, reader = gen2d.torch.dataset(windows, seed=7), Reader()
    order = gen2d.torch.sampler(data)
    for epoch in range(epochs):
        order.set_epoch(epoch)
        numbers = list(order)
        for first in range(0, len(numbers), 5):
            videos = [data[number] for number in numbers[first : first + 5]]
            names = "index", "window/start"
            reader.read(epoch, {name: np.array([int(video[name]) for video in videos]) for name in names})
    return reader.steps


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("workers", [0, 2])
def test_lightning_reads_other_windows_in_each_epoch_and_after_a_restart(
    windows: Any, workers: int, tmp_path: Any
) -> None:
    lightning, torch = package("lightning.pytorch"), package("torch")
    reader = Reader()

    class Model(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.layer = torch.nn.Linear(1, 1)

        def training_step(self, batch: Any, _: int) -> Any:
            reader.read(self.current_epoch, batch)
            return self.layer(batch["window/time"][:, :1].float()).mean()

        def configure_optimizers(self) -> Any:
            return torch.optim.SGD(self.parameters(), lr=0.1)

        def train_dataloader(self) -> Any:
            data = gen2d.torch.dataset(windows, seed=7)
            order = gen2d.torch.sampler(data)
            # Workers read ahead before Lightning itself sets the epoch of a restart.
            order.set_epoch(self.trainer.fit_loop.epoch_progress.current.processed)
            options: dict[str, Any] = {"num_workers": workers, "persistent_workers": workers > 0}
            return torch.utils.data.DataLoader(data, batch_size=5, sampler=order, **options)

    def fit(epochs: int, checkpoint: Any = None) -> None:
        keep = lightning.callbacks.ModelCheckpoint(tmp_path, "{epoch}", save_top_k=-1)
        quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
        lightning.Trainer(max_epochs=epochs, callbacks=[keep], **quiet).fit(Model(), ckpt_path=checkpoint)

    fit(3)
    expected = expected_steps(windows, 3)
    assert reader.steps == expected
    for epoch in (0, 1):
        reader.steps = []
        fit(3, tmp_path / f"epoch={epoch}.ckpt")
        assert reader.steps == [step for step in expected if step[0] > epoch]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("workers", [0, 2])
def test_accelerate_reads_other_windows_in_each_epoch(windows: Any, workers: int) -> None:
    accelerate, torch = package("accelerate"), package("torch")
    accelerator, reader = accelerate.Accelerator(cpu=True), Reader()
    data = gen2d.torch.dataset(windows, seed=7)
    order = gen2d.torch.sampler(data)
    model = torch.nn.Linear(1, 1)
    batches = torch.utils.data.DataLoader(data, batch_size=5, sampler=order, num_workers=workers)
    model, adam, batches = accelerator.prepare(model, torch.optim.Adam(model.parameters()), batches)
    for epoch in range(3):
        batches.set_epoch(epoch)
        for batch in batches:
            reader.read(epoch, batch)
            loss = model(batch["window/time"][:, :1].float()).mean()
            accelerator.backward(loss)
            adam.step()
            adam.zero_grad()
    assert reader.steps == expected_steps(windows, 3)
