"""Whether a dataset on disk is what was written: `quick` looks at names and sizes, `full` at every byte and value."""

import contextlib
import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gen2d import loader
from gen2d.errors import ConfigError, DamagedError, FolderError
from gen2d.files import file_sha256, size_of
from gen2d.manifest import field_of, read_manifest
from gen2d.plan import shard_path
from gen2d.remote import Place, Url, download, place, reading

LEVELS = ("quick", "full")

# Of static bodies these are infinite; in every other field a value that is not finite is an error.
INFINITE = ("objects/mass", "objects/moment")


@dataclasses.dataclass(frozen=True)
class Problem:
    """One thing that is wrong, in a sentence that names the file; `shard` is the one to make again, if that helps."""

    sentence: str
    shard: str = ""


def verify(
    root: str | Place, level: str = "quick", repair_with: Callable[[list[str]], object] | None = None
) -> list[str]:
    """What is wrong with the dataset, a sentence each; empty if nothing is.

    `repair_with` is called with the names of the bad shards, if there are problems, and must make these again and
    finish the dataset; what is returned is then what remains wrong.
    """
    found = list(problems(root, level))
    if found and repair_with is not None:
        repair_with(sorted({problem.shard for problem in found if problem.shard}))
        found = list(problems(root, level))
    return [problem.sentence for problem in found]


def damaged_shards(root: str | Place, level: str = "quick") -> list[str]:
    """The names of the shards that must be made again."""
    return sorted({problem.shard for problem in problems(root, level) if problem.shard})


def problems(root: str | Place, level: str = "quick") -> Iterator[Problem]:
    """Everything that is wrong, the folder first, then shard by shard."""
    root = place(root)
    if level not in LEVELS:
        raise ConfigError(f"level is {level!r}, but must be one of {', '.join(LEVELS)}")
    try:
        manifest = read_manifest(root)
    except (FolderError, DamagedError) as error:
        yield Problem(str(error))
        return
    with reading(root):
        whole = list(_hashed_files(root, manifest))
        missized = list(_shard_files(root, manifest))
    yield from [*whole, *missized]
    if level == "full":
        absent = {problem.shard for problem in missized}
        present = [shard for shard in manifest["shards"] if shard["name"] not in absent]
        with _nearby(root, manifest) as near, ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            for found in pool.map(lambda shard: _contents_near(root, near, manifest, shard, not whole), present):
                yield from found


def _hashed_files(root: Place, manifest: Mapping[str, Any]) -> Iterator[Problem]:
    for name, sha256 in manifest["files"].items():
        if not (root / name).is_file():
            yield Problem(f"{root / name} is missing")
        elif file_sha256(root / name) != sha256:
            yield Problem(f"{root / name} is not what was written")
    for path in (root / "index").rglob("*"):
        if path.is_file() and str(path).removeprefix(f"{root}/") not in manifest["files"]:
            yield Problem(f"{path} does not belong to the dataset")


def _shard_files(root: Place, manifest: Mapping[str, Any]) -> Iterator[Problem]:
    expected = {shard_path(root, shard["name"]): shard for shard in manifest["shards"]}
    with ThreadPoolExecutor(16) as pool:  # a server answers many questions at once
        sizes = list(pool.map(size_of, expected))
    for (path, shard), size in zip(expected.items(), sizes, strict=True):
        if size is None:
            yield Problem(f"{path} is missing", shard["name"])
        elif size != shard["bytes"]:
            yield Problem(f"{path} has {size} bytes, but was written with {shard['bytes']}", shard["name"])
    for path in sorted((root / "shards").glob("*")):
        if path not in expected:
            yield Problem(f"{path} does not belong to the dataset")


@contextlib.contextmanager
def _nearby(root: Place, manifest: Mapping[str, Any]) -> Iterator[Path]:
    """The dataset's folder; of a Url one on disk with all its files but the shards."""
    if isinstance(root, Path):
        yield root
        return
    with tempfile.TemporaryDirectory(prefix="gen2d-") as folder:
        near = Path(folder)
        (near / "shards").mkdir()
        for name in ("manifest.json", *manifest["files"]):
            (near / name).parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(OSError):  # what is missing has been told of
                download(root / name, near / name)
        yield near


def _contents_near(
    root: Place, near: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any], indexed: bool
) -> list[Problem]:
    """What is wrong within the shard, which is fetched first where it is not on disk."""
    if root == near:
        return list(_contents(near, manifest, shard, indexed))
    url, path = shard_path(root, shard["name"]), shard_path(near, shard["name"])
    assert isinstance(url, Url)
    assert isinstance(path, Path)
    try:
        download(url, path, shard["bytes"])
    except OSError as error:
        return [Problem(f"{url} cannot be read ({error.strerror})", shard["name"])]
    found = list(_contents(near, manifest, shard, indexed))
    os.truncate(path, 0)  # it may still be open
    return [Problem(problem.sentence.replace(str(near), str(root)), problem.shard) for problem in found]


def _contents(root: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any], indexed: bool) -> Iterator[Problem]:
    path = shard_path(root, shard["name"])
    try:
        intact = file_sha256(path) == shard["sha256"]
    except OSError as error:
        yield Problem(f"{path} cannot be read ({error})", shard["name"])
        return
    if not intact:
        yield Problem(f"{path} is not what was written: its sha256 differs", shard["name"])
    checks = [_pieces] if indexed else []
    if intact:  # else HDF5 has nothing to say that is worth more
        checks.append(_structure)
    for check in checks:
        for wrong in check(root, manifest, shard):
            yield Problem(f"{path}: {wrong}", shard["name"])


def _pieces(root: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with the stored pieces, each found by the index, checked and decoded as for training."""
    dataset = loader.open(root, shard["split"], fields=("*",))
    for number in range(shard["first"], shard["first"] + shard["count"]):
        try:
            values = dataset[number]
        except DamagedError as error:
            yield str(error)
            continue
        yield from (f"{name} of video {number} has {wrong}" for name, wrong in _not_finite(values))
        if "index" in values and values["index"] != number:
            yield f"index of video {number} is {values['index']}"


def _not_finite(values: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if value.dtype.kind != "f":
            continue
        if np.isnan(value).any():
            yield name, "values that are not a number"
        elif name not in INFINITE and np.isinf(value).any():
            yield name, "infinite values"


def _structure(root: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any]) -> Iterator[str]:
    """What differs between the file as HDF5 sees it and the manifest."""
    with h5py.File(shard_path(root, shard["name"]), "r") as file:
        if (file.attrs["split"], file.attrs["first"]) != (shard["split"], shard["first"]):
            yield f"it says that it begins with {file.attrs['split']} video {file.attrs['first']}"
        for name, about in manifest["fields"].items():
            dataset = file.get(name)
            if not isinstance(dataset, h5py.Dataset):
                yield f"{name} is missing"
                continue
            count = (shard["count"],) if field_of(about).per_video else ()
            yield from (f"{name} {wrong}" for wrong in _misdescribed(dataset, about, (*count, *about["shape"])))
            constant = manifest["constants"].get(name)
            if constant is not None and not np.array_equal(dataset[()], constant):
                yield f"{name} is not what the manifest says"


def _misdescribed(dataset: h5py.Dataset, about: Mapping[str, Any], shape: tuple[int, ...]) -> Iterator[str]:
    if dataset.shape != shape or dataset.dtype != np.dtype(about["dtype"]):
        yield f"is {dataset.dtype} {dataset.shape}, but must be {about['dtype']} {shape}"
    for key in ("axes", "unit", "meaning"):
        found = dataset.attrs.get(key)
        if found != about[key]:
            yield f"has {key} {found!r}, but must have {about[key]!r}"
