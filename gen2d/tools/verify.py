"""Whether a dataset on disk is what was written: `quick` looks at names and sizes, `full` at every byte and value,
`regen` also makes some videos again from their recipe and compares them to the bit."""

import contextlib
import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from gen2d.core.errors import ConfigError, DamagedError, Error, IncompleteError, UnreachableError, UserError, one_line
from gen2d.dataset.croissant import croissant
from gen2d.dataset.folder import is_foreign, next_manifest
from gen2d.dataset.hdf5_check import faults
from gen2d.dataset.manifest import FILE_BYTES, MANIFEST, MARK_SEAL, PLUGIN, Manifest, as_bytes, read_manifest
from gen2d.dataset.rows import check_shard, intact, npy_header, origin
from gen2d.dataset.spec import MARK, Shard, mark_path, plan, shard_name, shard_path
from gen2d.loading import dataset as loader
from gen2d.loading.epochs import order
from gen2d.storage.explain import reading_error, reason
from gen2d.storage.paths import Network, Place, Url, download, place, reading
from gen2d.storage.sealed import file_sha256, has_sha256, read_bytes, read_sealed, sha256

LEVELS = ("quick", "full", "regen")
VIDEOS = 8  # made again, unless told otherwise

# Of static bodies these are infinite; in every other field a value that is not finite is an error.
INFINITE = ("objects/mass", "objects/moment", "joints/stiffness", "joints/lower", "joints/upper")


@dataclasses.dataclass(frozen=True)
class Problem:
    """One thing that is wrong, in a sentence that names the file; `shard` is the one to make again, if that helps."""

    sentence: str
    shard: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sentence", one_line(self.sentence))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a check found, a sentence each, and what a repair did."""

    problems: list[str]  # what is wrong, after the repair if there was one
    repaired: list[str]  # what was wrong before it and is no more
    remade: list[str]  # names of the shards that were made again


Repair = Callable[[list[str]], Sequence[str] | None]


def verify(
    root: str | Place,
    level: str = "full",
    repair_with: Repair | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
    *,
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[str]:
    """What is wrong with the dataset, a sentence each; empty if nothing is.

    At the level "regen", as many `videos` as told are made again, chosen from `seed`; that imports jax, and raises
    FolderError where this machine would make other bits, and UntrustedError where it would run code that came with the
    dataset and is not trusted (`trust` holds the sha256 of what is). `repair_with` is called with the names of the bad
    shards, if there are problems, and must make these again and finish the dataset, as `regenerate.repair`
    does; what is returned is then what remains wrong. `timeout` and `deadline` are those of `open`.
    """
    return verify_and_repair(
        root, level, repair_with, videos, seed, trust=trust, timeout=timeout, deadline=deadline
    ).problems


def verify_and_repair(
    root: str | Place,
    level: str = "full",
    repair_with: Repair | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
    *,
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Outcome:
    """What `verify` finds, and what was repaired."""
    root = place(root, Network(timeout, deadline))
    found = problems(root, level, videos, seed, trust)
    if not found or repair_with is None:
        return Outcome([problem.sentence for problem in found], [], [])
    remade = repair_with(sorted({problem.shard for problem in found if problem.shard}))
    left = [problem.sentence for problem in problems(root, level, videos, seed, trust)]
    repaired = [problem.sentence for problem in found if problem.sentence not in left]
    return Outcome(left, repaired, list(remade or ()))


def damaged_shards(root: str | Place, level: str = "full") -> list[str]:
    """The names of the shards that must be made again."""
    return sorted({problem.shard for problem in problems(place(root), level) if problem.shard})


def problems(
    root: Place, level: str = "full", videos: int = VIDEOS, seed: int = 0, trust: Sequence[str] = ()
) -> list[Problem]:
    """Everything that is wrong, the folder first, then shard by shard, then what made again is another video.

    Where the dataset has grown meanwhile, and something seems wrong, all is checked anew.
    """
    if level not in LEVELS:
        raise ConfigError(f"level is {level!r}, but must be one of {', '.join(LEVELS)}")
    if videos < 1:
        raise ConfigError(f"--videos is {videos}, but must be 1 or more")
    while True:
        try:
            manifest = read_manifest(root)
        except (IncompleteError, DamagedError) as error:
            return [Problem(str(error))]
        try:
            found = list(_problems_of(root, manifest, level, videos, seed, trust))
        except Error:
            if _has(root, manifest):
                raise
            continue
        if not found or _has(root, manifest):
            return found


def _has(root: Place, manifest: Manifest) -> bool:
    """Whether the folder still has this manifest, or none that is whole."""
    try:
        return read_manifest(root).sha256 == manifest.sha256
    except Error:
        return True


def _problems_of(
    root: Place, manifest: Manifest, level: str, videos: int, seed: int, trust: Sequence[str]
) -> Iterator[Problem]:
    remade = _remade(root, manifest, videos, seed, trust) if level == "regen" else iter(())
    with reading(root):
        files = list(_files(root, manifest))
        tables, rows = _tables(root, manifest)
        shards = plan(manifest.splits, manifest.videos_per_shard)
        others = [*_mark(root, manifest), *_foreign(root, manifest)]
        missized = list(_sizes(root, shards, rows))
    yield from [*files, *tables, *others, *missized]
    if level != "quick":
        absent = {problem.shard for problem in [*tables, *missized]}
        present = [shard for shard in shards if shard.name not in absent]
        with _Contents(root, manifest, rows) as contents:
            for found in contents.check(present):
                yield from found
    yield from remade


def _remade(root: Place, manifest: Manifest, videos: int, seed: int, trust: Sequence[str]) -> Iterator[Problem]:
    """What differs in videos made again; raises FolderError, at once, where that cannot be judged here."""
    from gen2d.generation import regenerate  # imports jax

    source = regenerate.source_of(root, manifest.identity, trust)
    regenerate.check_fingerprint(root, source, manifest.identity)
    chosen = chosen_videos(manifest.splits, videos, seed)
    return (
        Problem(f"{shard_path(root, shard)}: {wrong}", shard)
        for shard, wrong in regenerate.changed_videos(source, root, manifest, chosen)
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


# ---- The folder


def _files(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """What is wrong with config, plug-ins, sheet and cards; README.md is for people, who may write in it."""
    coming = next_manifest(root)  # of a run that was killed in the middle of publishing it
    for name, expected in manifest.files.items():
        also = coming.files.get(name) if coming else None
        yield from map(Problem, _wrong(root / name, expected, also))
    also = sha256(croissant(coming)) if coming else None
    yield from map(Problem, _wrong(root / "croissant.json", sha256(croissant(manifest)), also))
    if not (root / "README.md").is_file():
        yield Problem(f"{root / 'README.md'} is missing")


def _wrong(path: Place, *expected: str | None) -> Iterator[str]:
    """What is wrong with a file that must have one of these sha256."""
    try:
        if not any(has_sha256(path, one, FILE_BYTES) for one in expected if one):
            yield f"{path} is not what was written"
    except FileNotFoundError:
        yield f"{path} is missing"
    except OSError as error:
        if isinstance(path, Url):  # of what a server does not give, nothing is known
            raise
        failure = reading_error(path, error)
        if isinstance(failure, UserError):
            raise failure from error
        yield str(failure)


def _tables(root: Place, manifest: Manifest) -> tuple[list[Problem], dict[str, np.ndarray]]:
    """What is wrong with the tables of the splits, and the rows of those that are what was written."""
    found, kept = [], {}
    kind, per_shard = manifest.shard_type, manifest.videos_per_shard
    sizes = manifest.video_type.itemsize, manifest.row_bytes, manifest.raw_bytes
    for split, table in manifest.tables.items():
        path, begin = root / table.file, origin(manifest.identity_sha256, split)
        header = npy_header(kind, table.shards)
        expected = len(header) + table.shards * kind.itemsize
        try:
            content = read_bytes(path, expected)
        except FileNotFoundError:
            found.append(Problem(f"{path} is missing"))
            continue
        except OSError as error:
            failure = reading_error(path, error)
            if isinstance(path, Url) or isinstance(failure, UserError):
                raise failure from error
            found.append(Problem(str(failure)))
            continue
        if sha256(content) != table.sha256 or len(content) != expected or content[: len(header)] != header:
            found.append(Problem(f"{path} is not what was written"))
            continue
        rows = np.frombuffer(content, kind, offset=len(header))
        firsts = range(0, table.shards * per_shard, per_shard)
        wrong = np.flatnonzero(~intact(rows, begin, firsts)).tolist()
        own = plan({split: manifest.splits[split]}, per_shard)
        for shard, row in zip(own, rows, strict=True):
            try:
                check_shard(row, shard.first, shard.count, *sizes)
            except DamagedError as error:
                found.append(Problem(f"{path} cannot be right in row {shard.place}: {error}", shard.name))
        found += [Problem(f"{path} is not what was written, in row {place}", own[place].name) for place in wrong]
        if int(rows["bytes"].sum()) != table.bytes or int(rows["bytes"].max()) != table.largest:
            found.append(Problem(f"{path} has shards of other sizes than {MANIFEST} says"))
        kept[split] = rows
    return found, kept


def _mark(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """What is wrong with what a later run needs; a copy may well have been made without it."""
    if isinstance(root, Url) and not mark_path(root).exists():
        return
    if (root / MARK).is_dir() or isinstance(root, Url):
        path = mark_path(root)
        said = read_sealed(path, MARK_SEAL) or {}
        if any(said.get(key) != value for key, value in manifest.identity.items()):
            yield Problem(f"{path} is {'not what was written' if path.exists() else 'missing'}")


def _foreign(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """Files that no run writes; shards that the manifest does not name yet are another matter."""
    for folder in ("shards", "index"):
        for path in sorted((root / folder).glob("*"), key=str):
            if is_foreign(path.name):
                yield Problem(f"{path} does not belong to the dataset")
    if isinstance(root, Path) and (root / "plugins").is_symlink():
        yield Problem(f"{root / 'plugins'} is a link, which no run makes")
        return
    for path in sorted((root / "plugins").rglob("*"), key=str):
        name = str(path).removeprefix(f"{root}/")
        if path.is_file() and name not in manifest.files and (PLUGIN.fullmatch(name) or isinstance(path, Path)):
            yield Problem(f"{path} does not belong to the dataset")


def _sizes(root: Place, shards: Sequence[Shard], rows: Mapping[str, np.ndarray]) -> Iterator[Problem]:
    paths = [shard_path(root, shard.name) for shard in shards]
    if isinstance(root, Url):
        with ThreadPoolExecutor(16) as pool:  # a server answers many questions at once
            sizes = list(pool.map(_size, paths))
    else:
        sizes = list(map(_size, paths))
    for shard, path, size in zip(shards, paths, sizes, strict=True):
        expected = int(rows[shard.split]["bytes"][shard.place]) if shard.split in rows else size
        if size is None:
            yield Problem(f"{path} is missing", shard.name)
        elif size != expected:
            yield Problem(f"{path} has {size} bytes, but was written with {expected}", shard.name)


def _size(path: Place) -> int | None:
    try:
        if not path.is_file():
            return None
        return path.stat().st_size
    except FileNotFoundError:
        return None
    except OSError as error:
        raise reading_error(path, error) from error


# ---- The shards


class _Contents:
    """Checks shards one by one, by their bytes, by every value, and by what HDF5 says; at a URL each is fetched."""

    def __init__(self, root: Place, manifest: Manifest, rows: Mapping[str, np.ndarray]) -> None:
        self.root, self.manifest, self.rows = root, manifest, rows

    def __enter__(self) -> "_Contents":
        self._stack = contextlib.ExitStack()
        try:
            self.near = self.root if isinstance(self.root, Path) else self._fetched_frame()
            opened = {split: loader.open(self.near, split, ("*",)) for split in self.rows}
        except BaseException:
            self._stack.close()
            raise
        self.opened = opened
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _fetched_frame(self) -> Path:
        """A folder on disk with the manifest and the tables of a remote dataset."""
        near = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="gen2d-")))
        for name in ("shards", "index"):
            (near / name).mkdir()
        (near / MANIFEST).write_bytes(as_bytes(self.manifest))
        for split in self.rows:
            table = self.manifest.tables[split]
            kind = self.manifest.shard_type
            rows = self.rows[split]
            (near / table.file).write_bytes(npy_header(kind, len(rows)) + rows.tobytes())
        return near

    def check(self, shards: Iterable[Shard]) -> Iterator[list[Problem]]:
        """What is wrong with each shard, in their order."""
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            yield from pool.map(self._checked, shards)

    def _checked(self, shard: Shard) -> list[Problem]:
        path = self.near / shard_name(shard.name)
        if self.root == self.near:
            return list(self._problems(path, shard))
        url = shard_path(self.root, shard.name)
        assert isinstance(url, Url)
        expected = self._row(shard)
        try:
            download(url, path, int(expected["bytes"]) if expected is not None else 0)
        except OSError as error:
            return [Problem(f"{url} cannot be read ({reason(error)})", shard.name)]
        found = list(self._problems(path, shard))
        os.truncate(path, 0)  # it may still be open
        return [Problem(problem.sentence.replace(str(self.near), str(self.root)), problem.shard) for problem in found]

    def _row(self, shard: Shard) -> np.void | None:
        return self.rows[shard.split][shard.place] if shard.split in self.rows else None

    def _problems(self, path: Path, shard: Shard) -> Iterator[Problem]:
        row = self._row(shard)
        try:
            digest = file_sha256(path)
        except OSError as error:
            failure = reading_error(path, error)
            if isinstance(failure, UserError):
                raise failure from error
            yield Problem(str(failure), shard.name)
            return
        if row is None:
            return  # its table is wrong, which has been said
        whole = digest == row["sha256"].tobytes().hex()
        if not whole:
            yield Problem(f"{path} is not what was written: its sha256 differs", shard.name)
        for sentence in self._pieces(shard):
            yield Problem(sentence if sentence.startswith(str(path)) else f"{path}: {sentence}", shard.name)
        if whole:  # else HDF5 has nothing to say that is worth more
            yield from (Problem(f"{path}: {said}", shard.name) for said in faults(path, shard, self.manifest))

    def _pieces(self, shard: Shard) -> Iterator[str]:
        """What is wrong with the stored pieces, each found by the index, checked and decoded as for training."""
        dataset = self.opened[shard.split]
        for number in range(shard.first, shard.first + shard.count):
            try:
                values = dataset.batch([number])
            except DamagedError as error:
                yield str(error)
                continue
            except UnreachableError as error:
                yield str(error)
                return
            yield from (f"{name} of video {number} has {wrong}" for name, wrong in _not_finite(values))
            if "index" in values and values["index"][0] != number:
                yield f"index of video {number} is {values['index'][0]}"


def _not_finite(values: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if value.dtype.kind != "f":
            continue
        if np.isnan(value).any():
            yield name, "values that are not a number"
        elif name not in INFINITE and np.isinf(value).any():
            yield name, "infinite values"
