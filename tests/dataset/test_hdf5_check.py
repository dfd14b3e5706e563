"""What HDF5 reads in a file is what the manifest says of it, and no file crashes it or keeps it busy."""

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import synthetic

from gen2d.dataset import hdf5_check
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.spec import plan, shard_name


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "data", train=3)))


def faults_of(root: Path) -> list[str]:
    """Faults of the first shard."""
    manifest = read_manifest(root)
    shard = plan({"train": 3}, manifest.videos_per_shard)[0]
    return hdf5_check.faults(root / shard_name(shard.name), shard, manifest)


def replaced(file: h5py.File, name: str, values: np.ndarray, **options: object) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=values, **options).attrs.update(attributes)


CHANGES: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "unit": (
        lambda file: file["states/angle"].attrs.update(unit="degree"),
        "states/angle has unit 'degree', but must have 'rad'",
    ),
    "axes": (
        lambda file: file["states/angle"].attrs.update(axes="n K T"),
        "states/angle has axes 'n K T', but must have 'n T K'",
    ),
    "constant": (
        lambda file: replaced(file, "time", np.tile(np.arange(5.0), (3, 1))),
        "time differs from the manifest",
    ),
    "missing": (lambda file: file.pop("states/angle"), "states/angle is missing"),
    "type": (
        lambda file: replaced(file, "states/angle", np.zeros((3, 5, 3))),
        "states/angle is float64 [3, 5, 3], but must be float32 [3, 5, 3]",
    ),
    "shape": (
        lambda file: replaced(file, "states/angle", np.zeros((3, 3, 5), np.float32)),
        "states/angle is float32 [3, 3, 5], but must be float32 [3, 5, 3]",
    ),
    "compressed": (
        lambda file: replaced(file, "states/angle", np.zeros((3, 5, 3), np.float32), compression="gzip"),
        "states/angle is compressed, but must not be",
    ),
    "external": (
        lambda file: replaced(file, "index", np.arange(3), external=[(f"{file.filename}.raw", 0, 24)]),
        "index lies in another file",
    ),
    "split": (lambda file: file.attrs.update(split="test"), "its attributes say that it begins with test video 0"),
    "first": (lambda file: file.attrs.update(first=8), "its attributes say that it begins with train video 8"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_file_that_hdf5_reads_otherwise_is_found(root: Path, change: str) -> None:
    assert faults_of(root) == []
    changed, sentence = CHANGES[change]
    with h5py.File(root / "shards" / "train-00000-n3.h5", "r+") as file:
        changed(file)
    assert faults_of(root) == [sentence]


def test_a_file_that_keeps_hdf5_busy_or_crashes_it_is_found(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert faults_of(root) == []
    busy = hdf5_check._checker_process()
    busy.send_signal(signal.SIGSTOP)
    with monkeypatch.context() as patch:
        patch.setattr(hdf5_check, "SECONDS", 0.2)
        assert faults_of(root) == ["HDF5 has not finished reading it after 0 s"]
    assert busy.wait(10) == -signal.SIGKILL
    crashing = hdf5_check._checker_process()
    crashing.send_signal(signal.SIGSTOP)
    threading.Timer(0.2, os.kill, (crashing.pid, signal.SIGKILL)).start()
    assert faults_of(root) == ["HDF5 crashed while reading it"]
    assert faults_of(root) == []
