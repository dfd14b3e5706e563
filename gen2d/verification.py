"""Whether a dataset on disk is what was written: `quick` looks at names and sizes, `full` at every byte and value,
`regen` also makes some videos again from their recipe and compares them to the bit."""

import contextlib
import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gen2d.core.errors import ConfigError, DamagedError, FolderError
from gen2d.dataset.cards import croissant
from gen2d.dataset.manifest import MARK_SEAL, field_of, read_manifest, read_record
from gen2d.dataset.spec import IDENTITY, MARK, mark_path, record_path, shard_path, table_path
from gen2d.loading import dataset as loader
from gen2d.loading.epochs import order
from gen2d.storage.atomic import as_json, file_sha256, sealed, sha256, size_of
from gen2d.storage.paths import Place, Url, download, place, reading

LEVELS = ("quick", "full", "regen")
VIDEOS = 8  # made again, unless told otherwise

# Of static bodies these are infinite; in every other field a value that is not finite is an error.
INFINITE = ("objects/mass", "objects/moment", "joints/stiffness", "joints/lower", "joints/upper")


@dataclasses.dataclass(frozen=True)
class Problem:
    """One thing that is wrong, in a sentence that names the file; `shard` is the one to make again, if that helps."""

    sentence: str
    shard: str = ""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a check found, a sentence each, and what a repair did."""

    problems: list[str]  # what is wrong, after the repair if there was one
    repaired: list[str]  # what was wrong before it and is no more
    remade: list[str]  # names of the shards that were made again


def verify(
    root: str | Place,
    level: str = "quick",
    repair_with: Callable[[list[str]], Sequence[str] | None] | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
) -> list[str]:
    """What is wrong with the dataset, a sentence each; empty if nothing is.

    At the level "regen", as many `videos` as told are made again, chosen from `seed`; that imports jax, and raises
    FolderError where this machine would make other bits. `repair_with` is called with the names of the bad shards, if
    there are problems, and must make these again and finish the dataset, as `gen2d.regeneration.repair` does; what is
    returned is then what remains wrong.
    """
    return checked(root, level, repair_with, videos, seed).problems


def checked(
    root: str | Place,
    level: str = "quick",
    repair_with: Callable[[list[str]], Sequence[str] | None] | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
) -> Outcome:
    """What `verify` finds, and what was repaired."""
    found = list(problems(root, level, videos, seed))
    if not found or repair_with is None:
        return Outcome([problem.sentence for problem in found], [], [])
    remade = repair_with(sorted({problem.shard for problem in found if problem.shard}))
    left = [problem.sentence for problem in problems(root, level, videos, seed)]
    repaired = [problem.sentence for problem in found if problem.sentence not in left]
    return Outcome(left, repaired, list(remade or ()))


def damaged_shards(root: str | Place, level: str = "quick") -> list[str]:
    """The names of the shards that must be made again."""
    return sorted({problem.shard for problem in problems(root, level) if problem.shard})


def problems(root: str | Place, level: str = "quick", videos: int = VIDEOS, seed: int = 0) -> Iterator[Problem]:
    """Everything that is wrong, the folder first, then shard by shard, then what made again is another video."""
    root = place(root)
    if level not in LEVELS:
        raise ConfigError(f"level is {level!r}, but must be one of {', '.join(LEVELS)}")
    if videos < 1:
        raise ConfigError(f"--videos is {videos}, but must be 1 or more")
    try:
        manifest = read_manifest(root)
    except (FolderError, DamagedError) as error:
        yield Problem(str(error))
        return
    remade = _remade(root, manifest, videos, seed) if level == "regen" else iter(())
    with reading(root):
        whole = list(_hashed_files(root, manifest))
        others = [*_cards(root, manifest), *_records(root, manifest)]
        missized = list(_shard_files(root, manifest))
    yield from [*whole, *others, *missized]
    if level != "quick":
        absent = {problem.shard for problem in missized}
        present = [shard for shard in manifest["shards"] if shard["name"] not in absent]
        with _nearby(root, manifest) as near, ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            # Opened here, not in the threads: NumPy parses the headers of the index by `ast`, in which threads of
            # CPython 3.11 have been seen to disturb each other (SystemError: recursion depth mismatch).
            opened = {} if whole else {split: loader.open(near, split, ("*",)) for split in manifest["splits"]}
            for found in pool.map(lambda shard: _contents_near(root, near, manifest, shard, opened), present):
                yield from found
    yield from remade


def _remade(root: Place, manifest: Mapping[str, Any], videos: int, seed: int) -> Iterator[Problem]:
    """What differs in videos made again; raises FolderError, at once, where that cannot be judged here."""
    from gen2d import regeneration  # imports jax

    rollout = regeneration.rollout_of(root, manifest)
    regeneration.check_fingerprint(root, rollout, manifest)
    chosen = chosen_videos(manifest["splits"], videos, seed)
    return (
        Problem(f"{shard_path(root, shard)}: {wrong}", shard)
        for shard, wrong in regeneration.differing(rollout, root, manifest, chosen)
    )


def chosen_videos(splits: Mapping[str, int], videos: int, seed: int) -> list[tuple[str, int]]:
    """Split and number of as many videos as asked, or of all there are: which, the seed decides."""
    everything = sum(splits.values())
    places = np.sort(order(seed, 0, np.arange(min(videos, everything)), everything))
    ends = np.cumsum(list(splits.values()))
    owner = np.searchsorted(ends, places, side="right")
    return [
        (list(splits)[k], int(place - ends[k] + list(splits.values())[k]))
        for k, place in zip(owner, places, strict=True)
    ]


def _hashed_files(root: Place, manifest: Mapping[str, Any]) -> Iterator[Problem]:
    for name, expected in manifest["files"].items():
        yield from map(Problem, _wrong(root / name, expected))
    for path in sorted([*(root / "index").rglob("*"), *(root / "plugins").rglob("*")], key=str):
        if path.is_file() and str(path).removeprefix(f"{root}/") not in manifest["files"]:
            yield Problem(f"{path} does not belong to the dataset")


def _wrong(path: Place, expected: str) -> Iterator[str]:
    """What is wrong with a file that must have this sha256."""
    try:
        if not path.is_file():
            yield f"{path} is missing"
        elif file_sha256(path) != expected:
            yield f"{path} is not what was written"
    except OSError as error:
        if isinstance(path, Url):  # of what a server does not give, nothing is known
            raise
        yield f"{path} cannot be read ({error.strerror or error})"


def _cards(root: Place, manifest: Mapping[str, Any]) -> Iterator[Problem]:
    """README.md is for people, who may write in it, so it only has to be there."""
    yield from map(Problem, _wrong(root / "croissant.json", sha256(as_json(croissant(manifest)))))
    if not (root / "README.md").is_file():
        yield Problem(f"{root / 'README.md'} is missing")


def _records(root: Place, manifest: Mapping[str, Any]) -> Iterator[Problem]:
    """What is wrong with what a later run needs; a copy may well have been made without it."""
    if not (root / MARK).is_dir():
        return
    identity = {key: manifest[key] for key in IDENTITY}
    yield from map(Problem, _wrong(mark_path(root), sha256(as_json(sealed(identity, MARK_SEAL)))))
    with ThreadPoolExecutor(16) as pool:  # a server answers many questions at once
        for found in pool.map(lambda shard: list(_record(root, shard)), manifest["shards"]):
            yield from found
    expected = {f"{shard['name']}.{kind}" for shard in manifest["shards"] for kind in ("json", "npz")}
    for path in sorted((root / MARK / "done").glob("*"), key=str):
        if path.name not in expected:
            yield Problem(f"{path} does not belong to the dataset")


def _record(root: Place, shard: Mapping[str, Any]) -> Iterator[Problem]:
    path, record = record_path(root, shard["name"]), read_record(root, shard["name"])
    if record is None or any(record[key] != shard[key] for key in shard):
        yield Problem(f"{path} is {'not what was written' if path.is_file() else 'missing'}", shard["name"])
    else:
        tables = _wrong(table_path(root, shard["name"]), record["tables_sha256"])
        yield from (Problem(sentence, shard["name"]) for sentence in tables)


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


Opened = Mapping[str, loader.Dataset]  # by split; nothing where the index cannot be trusted


def _contents_near(
    root: Place, near: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any], opened: Opened
) -> list[Problem]:
    """What is wrong within the shard, which is fetched first where it is not on disk."""
    if root == near:
        return list(_contents(near, manifest, shard, opened))
    url, path = shard_path(root, shard["name"]), shard_path(near, shard["name"])
    assert isinstance(url, Url)
    assert isinstance(path, Path)
    try:
        download(url, path, shard["bytes"])
    except OSError as error:
        return [Problem(f"{url} cannot be read ({error.strerror})", shard["name"])]
    found = list(_contents(near, manifest, shard, opened))
    os.truncate(path, 0)  # it may still be open
    return [Problem(problem.sentence.replace(str(near), str(root)), problem.shard) for problem in found]


def _contents(root: Path, manifest: Mapping[str, Any], shard: Mapping[str, Any], opened: Opened) -> Iterator[Problem]:
    path = shard_path(root, shard["name"])
    try:
        intact = file_sha256(path) == shard["sha256"]
    except OSError as error:
        yield Problem(f"{path} cannot be read ({error})", shard["name"])
        return
    if not intact:
        yield Problem(f"{path} is not what was written: its sha256 differs", shard["name"])
    wrong = list(_pieces(opened[shard["split"]], shard)) if opened else []
    if intact:  # else HDF5 has nothing to say that is worth more
        wrong += _structure(root, manifest, shard)
    yield from (Problem(f"{path}: {sentence}", shard["name"]) for sentence in wrong)


def _pieces(dataset: loader.Dataset, shard: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with the stored pieces, each found by the index, checked and decoded as for training."""
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
