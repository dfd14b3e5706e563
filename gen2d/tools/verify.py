"""Verification of a stored dataset, at three levels.

`quick` checks names and sizes, `full` every byte and value. `regen` also regenerates some videos from their recipe and
compares them to the bit.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from gen2d._version import __version__
from gen2d.core.errors import (
    ConfigError,
    DamagedError,
    Error,
    IncompleteError,
    UnreachableError,
    UserError,
    argument,
    one_line,
)
from gen2d.core.progress import Log, inform, progress, waiting
from gen2d.dataset.croissant import croissant
from gen2d.dataset.folder import is_foreign
from gen2d.dataset.hdf5_check import faults
from gen2d.dataset.manifest import MARK_SEAL, Manifest, as_bytes, read_manifest
from gen2d.dataset.manifest_parser import FILE_BYTES
from gen2d.dataset.rows import check_shard, intact, npy, npy_header, npy_size, origin
from gen2d.dataset.snapshots import next_manifest
from gen2d.dataset.spec import MANIFEST, MARK, PLUGIN, Shard, mark_path, plan, shard_name, shard_path
from gen2d.engines.protocol import Engine, EngineError, Report, other_version, results
from gen2d.loading import dataset as loader
from gen2d.loading.epochs import order
from gen2d.storage.atomic import size_of
from gen2d.storage.explain import reading_error, reason
from gen2d.storage.paths import Place, Url, download, place, reading
from gen2d.storage.retries import Network
from gen2d.storage.sealed import file_sha256, has_sha256, read_bytes, read_sealed, sha256

LEVELS = ("quick", "full", "regen")
VIDEOS = 8  # default number of videos to regenerate

# Fields that may be infinite, for static bodies and rigid joints; in all others a value that is not finite is an error.
INFINITE = ("objects/mass", "objects/moment", "joints/stiffness", "joints/lower", "joints/upper")


@dataclasses.dataclass(frozen=True)
class Problem:
    """A problem of a dataset: a sentence that names the file, and the shard to regenerate, if any."""

    sentence: str
    shard: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sentence", one_line(self.sentence))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Problems that a check found, a sentence each, and the result of a repair."""

    problems: list[str]  # remaining ones, after the repair if there was one
    repaired: list[str]  # solved by the repair
    remade: list[str]  # names of regenerated shards


Repair = Callable[[list[str]], Sequence[str] | None]


def verify(
    root: str | Place,
    level: str = "full",
    repair_with: Repair | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
    *,
    trust: Sequence[str] = (),
    engine: Engine | None = None,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> list[str]:
    """Problems of a dataset.

    Parameters
    ----------
    root : str or path
        Folder or URL of the dataset.
    level : str
        "quick" checks names and sizes, "full" every byte and value; "regen" also regenerates some videos and compares
        them to the bit, for which it imports jax.
    repair_with : callable, optional
        Called with the names of damaged shards if there are problems. It must regenerate these and complete the
        dataset, as `regenerate.repair` does; the dataset is then checked again.
    videos : int
        Number of videos that "regen" regenerates, 1 or more.
    seed : int
        Seed of their random choice.
    trust : sequence of str
        sha256 of code in the dataset that may run, as in `render`; only for "regen".
    engine : gen2d.engines.Ray, optional
        Where the shards are read and checked; by default in this process. "regen" regenerates in this process.
    timeout : float
        Limit in s of a server's silence, as in `open`.
    deadline : float
        Limit in s of a whole request, as in `open`.

    Returns
    -------
    list of str
        A sentence for each problem, those that remain after a repair; empty if the dataset is intact.

    Raises
    ------
    ConfigError
        If an argument is invalid.
    FolderError
        If the folder cannot be read, or, with "regen", if this machine or these versions would generate other bits.
    UntrustedError
        If "regen" needs code of the dataset that is not trusted.
    UnreachableError
        If a server does not answer.

    Examples
    --------
    >>> gen2d.verify("datasets/bouncing", "regen", videos=4)
    []
    """
    root = place(root, Network(timeout, deadline))
    return verify_and_repair(root, level, repair_with, videos, seed, trust, engine).problems


def verify_and_repair(
    root: Place,
    level: str,
    repair_with: Repair | None = None,
    videos: int = VIDEOS,
    seed: int = 0,
    trust: Sequence[str] = (),
    engine: Engine | None = None,
) -> Outcome:
    """Result of `verify`, with the repaired problems and the regenerated shards."""
    before = find_problems(root, level, videos, seed, trust, engine)
    if not before or repair_with is None:
        return Outcome([problem.sentence for problem in before], [], [])
    remade = repair_with(sorted({problem.shard for problem in before if problem.shard}))
    remaining = [problem.sentence for problem in find_problems(root, level, videos, seed, trust, engine)]
    repaired = [problem.sentence for problem in before if problem.sentence not in remaining]
    return Outcome(remaining, repaired, list(remade or ()))


def damaged_shards(root: str | Place, level: str = "full") -> list[str]:
    """Names of the shards that must be regenerated."""
    return sorted({problem.shard for problem in find_problems(place(root), level) if problem.shard})


def find_problems(
    root: Place,
    level: str = "full",
    videos: int = VIDEOS,
    seed: int = 0,
    trust: Sequence[str] = (),
    engine: Engine | None = None,
) -> list[Problem]:
    """All problems of the folder, then of the shards in their order, then of regenerated videos.

    The check starts again if it finds problems and the dataset has grown meanwhile.
    """
    if level not in LEVELS:
        raise ConfigError(f"level is {level!r}, but must be one of {', '.join(LEVELS)}")
    if videos < 1:
        raise ConfigError(f"{argument('videos')} is {videos}, but must be 1 or more")
    while True:
        try:
            manifest = read_manifest(root)
        except (IncompleteError, DamagedError) as error:
            return [Problem(str(error))]
        try:
            problems = list(_problems_of(root, manifest, level, videos, seed, trust, engine))
        except Error:
            if _has_manifest(root, manifest):
                raise
            continue
        if not problems or _has_manifest(root, manifest):
            return problems


def _has_manifest(root: Place, manifest: Manifest) -> bool:
    """Whether the folder still has this manifest, or no intact one."""
    try:
        return read_manifest(root).sha256 == manifest.sha256
    except Error:
        return True


def _problems_of(
    root: Place,
    manifest: Manifest,
    level: str,
    videos: int,
    seed: int,
    trust: Sequence[str],
    engine: Engine | None,
) -> Iterator[Problem]:
    changed = _changed_videos(root, manifest, videos, seed, trust) if level == "regen" else iter(())
    with reading(root):
        files = list(_check_files(root, manifest))
        tables, rows = _check_tables(root, manifest)
        shards = plan(manifest.splits, manifest.videos_per_shard)
        others = [*_check_mark(root, manifest), *_foreign_files(root, manifest)]
        sizes = list(_check_sizes(root, shards, rows))
    yield from [*files, *tables, *others, *sizes]
    if level != "quick":
        reported = {problem.shard for problem in [*tables, *sizes]}
        unreported, checked = [shard for shard in shards if shard.name not in reported], 0

        def status(_: float) -> str:
            return f"Checked {checked:,} of {len(unreported):,} shards"

        if engine is not None:
            yield from _check_on(engine, root, manifest, unreported)
            unreported = []
        with _ShardChecker(root, manifest, rows) as checker, waiting("Checking every byte of the shards", None, status):
            for problems in checker.check(unreported):
                yield from problems
                checked += 1
    with waiting(f"Compiling, and regenerating {videos} videos"):
        yield from changed


def _changed_videos(root: Place, manifest: Manifest, videos: int, seed: int, trust: Sequence[str]) -> Iterator[Problem]:
    """Differing fields of regenerated videos.

    Raises FolderError, before anything is yielded, if this machine generates other bits.
    """
    with waiting("Importing jax"):
        from gen2d.generation import regenerate

    source = regenerate.source_of(root, manifest.identity, trust)
    regenerate.check_fingerprint(root, source, manifest.identity)
    chosen = chosen_videos(manifest.splits, videos, seed)
    return (
        Problem(f"{shard_path(root, shard)}: {difference}", shard)
        for shard, difference in regenerate.changed_videos(source, root, manifest, chosen)
    )


def chosen_videos(splits: Mapping[str, int], videos: int, seed: int) -> list[tuple[str, int]]:
    """Split and number of `videos` random videos, or of all if there are fewer."""
    total = sum(splits.values())
    positions = np.sort(order(seed, 0, np.arange(min(videos, total)), total))
    ends = np.cumsum(list(splits.values()))
    split_index = np.searchsorted(ends, positions, side="right")
    return [
        (list(splits)[k], int(position - ends[k]) + list(splits.values())[k])
        for k, position in zip(split_index.tolist(), positions.tolist(), strict=True)
    ]


# ---- The folder


def _check_files(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """Problems of config, plug-ins, contact sheet and cards; people may edit README.md."""
    upcoming = next_manifest(root)  # left by a run that was killed while it published this manifest
    for name, expected in manifest.files.items():
        next_sha256 = upcoming.files.get(name) if upcoming else None
        yield from map(Problem, _check_hash(root / name, expected, next_sha256))
    next_sha256 = sha256(croissant(upcoming)) if upcoming else None
    yield from map(Problem, _check_hash(root / "croissant.json", sha256(croissant(manifest)), next_sha256))
    if not (root / "README.md").is_file():
        yield Problem(f"{root / 'README.md'} is missing")


def _check_hash(path: Place, *expected: str | None) -> Iterator[str]:
    """Problems of a file that must have one of these sha256."""
    try:
        if not any(has_sha256(path, one, FILE_BYTES) for one in expected if one):
            yield f"{path} is not what was written"
    except FileNotFoundError:
        yield f"{path} is missing"
    except OSError as error:
        if isinstance(path, Url):  # the file may be intact
            raise
        failure = reading_error(path, error)
        if isinstance(failure, UserError):
            raise failure from error
        yield str(failure)


def _check_tables(root: Place, manifest: Manifest) -> tuple[list[Problem], dict[str, np.ndarray]]:
    """Problems of the splits' tables, and the rows of the intact tables by split."""
    problems: list[Problem] = []
    rows_of: dict[str, np.ndarray] = {}
    dtype, per_shard = manifest.shard_type, manifest.videos_per_shard
    sizes = manifest.video_type.itemsize, manifest.row_bytes, manifest.raw_bytes
    for split, table in manifest.tables.items():
        path, begin = root / table.file, origin(manifest.identity_sha256, split)
        header, expected = npy_header(dtype, table.shards), npy_size(dtype, table.shards)
        try:
            content = read_bytes(path, expected)
        except FileNotFoundError:
            problems.append(Problem(f"{path} is missing"))
            continue
        except OSError as error:
            failure = reading_error(path, error)
            if isinstance(path, Url) or isinstance(failure, UserError):
                raise failure from error
            problems.append(Problem(str(failure)))
            continue
        if sha256(content) != table.sha256 or len(content) != expected or content[: len(header)] != header:
            problems.append(Problem(f"{path} is not what was written"))
            continue
        rows = np.frombuffer(content, dtype, offset=len(header))
        firsts = range(0, table.shards * per_shard, per_shard)
        damaged = np.flatnonzero(~intact(rows, begin, firsts)).tolist()
        split_shards = plan({split: manifest.splits[split]}, per_shard)
        for shard, row in zip(split_shards, rows, strict=True):
            try:
                check_shard(row, shard.first, shard.count, *sizes)
            except DamagedError as error:
                problems.append(Problem(f"{path} has an impossible row {shard.place}: {error}", shard.name))
        problems += [
            Problem(f"{path} is not what was written, in row {row}", split_shards[row].name) for row in damaged
        ]
        if int(rows["bytes"].sum()) != table.bytes or int(rows["bytes"].max()) != table.largest:
            problems.append(Problem(f"{path} has shards of other sizes than {MANIFEST} says"))
        rows_of[split] = rows
    return problems, rows_of


def _check_mark(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """Problems of the mark, which later runs need; a copy of a dataset may lack it."""
    if isinstance(root, Url) and not mark_path(root).exists():
        return
    if (root / MARK).is_dir() or isinstance(root, Url):
        path = mark_path(root)
        mark = read_sealed(path, MARK_SEAL) or {}
        if any(mark.get(key) != value for key, value in manifest.identity.items()):
            yield Problem(f"{path} is {'not what was written' if path.exists() else 'missing'}")


def _foreign_files(root: Place, manifest: Manifest) -> Iterator[Problem]:
    """Files that no run writes; shards that the manifest does not name yet are allowed."""
    for folder in ("shards", "index"):
        for path in sorted((root / folder).glob("*"), key=str):
            if is_foreign(path.name):
                yield Problem(f"{path} does not belong to the dataset")
    if isinstance(root, Path) and (root / "plugins").is_symlink():
        yield Problem(f"{root / 'plugins'} is a link, but gen2d makes no links")
        return
    for path in sorted((root / "plugins").rglob("*"), key=str):
        name = str(path).removeprefix(f"{root}/")
        if path.is_file() and name not in manifest.files and (PLUGIN.fullmatch(name) or isinstance(path, Path)):
            yield Problem(f"{path} does not belong to the dataset")


def _check_sizes(root: Place, shards: Sequence[Shard], rows: Mapping[str, np.ndarray]) -> Iterator[Problem]:
    """Shards whose files are missing or differ in size from their rows."""

    def size(path: Place) -> int | None:
        try:
            return size_of(path)
        except OSError as error:
            raise reading_error(path, error) from error

    paths = [shard_path(root, shard.name) for shard in shards]
    if isinstance(root, Url):
        with ThreadPoolExecutor(16) as pool:  # a server answers many requests at once
            sizes = list(pool.map(size, paths))
    else:
        sizes = list(map(size, paths))
    for shard, path, actual in zip(shards, paths, sizes, strict=True):
        expected = int(rows[shard.split]["bytes"][shard.place]) if shard.split in rows else actual
        if actual is None:
            yield Problem(f"{path} is missing", shard.name)
        elif actual != expected:
            yield Problem(f"{path} has {actual} bytes, but was written with {expected}", shard.name)


# ---- The shards


class _ShardChecker:
    """Check shards by their bytes, by all values, and by HDF5's structure; at a URL each is downloaded first."""

    def __init__(self, root: Place, manifest: Manifest, rows: Mapping[str, np.ndarray]) -> None:
        self.root, self.manifest, self.rows = root, manifest, rows

    def __enter__(self) -> "_ShardChecker":
        with contextlib.ExitStack() as stack:
            if isinstance(self.root, Path):
                self.local = self.root
            else:  # a local folder with the manifest and the tables, for the downloaded shards
                self.local = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gen2d-")))
                for name in ("shards", "index"):
                    (self.local / name).mkdir()
                (self.local / MANIFEST).write_bytes(as_bytes(self.manifest))
                for split, rows in self.rows.items():
                    (self.local / self.manifest.tables[split].file).write_bytes(npy(rows))
            self.datasets = {split: loader.open(self.local, split, ("*",)) for split in self.rows}
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def check(self, shards: Iterable[Shard]) -> Iterator[list[Problem]]:
        """Problems of each shard, in order."""
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            yield from pool.map(self._check, shards)

    def _check(self, shard: Shard) -> list[Problem]:
        path = self.local / shard_name(shard.name)
        row = self.rows[shard.split][shard.place] if shard.split in self.rows else None
        if self.root == self.local:
            return list(self._problems(path, shard, row))
        url = shard_path(self.root, shard.name)
        assert isinstance(url, Url)
        try:
            download(url, path, int(row["bytes"]) if row is not None else 0)
        except OSError as error:
            return [Problem(f"{url} cannot be read ({reason(error)})", shard.name)]
        problems = list(self._problems(path, shard, row))
        os.truncate(path, 0)  # it may still be open
        return [Problem(each.sentence.replace(str(self.local), str(self.root)), each.shard) for each in problems]

    def _problems(self, path: Path, shard: Shard, row: np.void | None) -> Iterator[Problem]:
        try:
            digest = file_sha256(path)
        except OSError as error:
            failure = reading_error(path, error)
            if isinstance(failure, UserError):
                raise failure from error
            yield Problem(str(failure), shard.name)
            return
        if row is None:
            return  # its table is damaged, which is already reported
        same_bytes = digest == row["sha256"].tobytes().hex()
        if not same_bytes:
            yield Problem(f"{path} is not what was written: its sha256 differs", shard.name)
        for sentence in self._check_values(shard):
            yield Problem(sentence if sentence.startswith(str(path)) else f"{path}: {sentence}", shard.name)
        if same_bytes:  # otherwise HDF5's errors add nothing
            yield from (Problem(f"{path}: {fault}", shard.name) for fault in faults(path, shard, self.manifest))

    def _check_values(self, shard: Shard) -> Iterator[str]:
        """Problems of the stored values, which are read, checked and decoded as for training."""
        dataset = self.datasets[shard.split]
        for number in range(shard.first, shard.first + shard.count):
            try:
                values = dataset.batch([number])
            except DamagedError as error:
                yield str(error)
                continue
            except UnreachableError as error:
                yield str(error)
                return
            for name, value in values.items():
                if value.dtype.kind == "f" and np.isnan(value).any():
                    yield f"{name} of video {number} has values that are not a number"
                elif value.dtype.kind == "f" and name not in INFINITE and np.isinf(value).any():
                    yield f"{name} of video {number} has infinite values"
            if "index" in values and values["index"][0] != number:
                yield f"index of video {number} is {values['index'][0]}"


# ---- On a cluster


def _check_on(engine: Engine, root: Place, manifest: Manifest, shards: Sequence[Shard]) -> Iterator[Problem]:
    """Problems of these shards, in their order, found by the workers of an engine."""
    found: dict[Shard, list[Problem]] = {}
    there = root.absolute() if isinstance(root, Path) else root
    for shard, sentences, _ in results(engine, _CheckJob(there, manifest.sha256), shards, inform):
        found[shard] = [Problem(sentence.replace(str(there), str(root)), shard.name) for sentence in sentences]
    for shard in shards:
        yield from found[shard]


class _CheckJob:
    """Shards to check, for an engine."""

    title, unit, noun, device = "Checking", "shards", "shard", "cpu"

    def __init__(self, root: Place, manifest_sha256: str) -> None:
        self.open = functools.partial(_CheckWorker, root, manifest_sha256)

    def size(self, item: Shard) -> int:
        return 1

    def refusals(self, reports: Sequence[Report]) -> list[str]:
        return [other_version(report) for report in reports]


class _CheckWorker:
    """Worker that checks shards of the dataset with this manifest."""

    def __init__(self, root: Place, manifest_sha256: str, device: str, log: Log) -> None:
        self.root, self.manifest_sha256, self.stack = root, manifest_sha256, contextlib.ExitStack()

    def report(self) -> Report:
        return Report("cpu", versions={"gen2d": __version__}, group=min(os.cpu_count() or 1, 8))

    def check(self) -> str:
        try:
            with reading(self.root):
                manifest = read_manifest(self.root)
                rows = _check_tables(self.root, manifest)[1]
        except Error as error:
            return str(error)
        if manifest.sha256 != self.manifest_sha256:
            return f"it sees another dataset in {self.root}"
        self.checker = self.stack.enter_context(_ShardChecker(self.root, manifest, rows))
        return ""

    def run(self, items: Sequence[Shard]) -> list[list[str]]:
        return [[problem.sentence for problem in problems] for problems in self.checker.check(items)]

    def run_all(self, items: Sequence[Shard], log: Log) -> list[list[str]]:
        refusal = self.check()
        if refusal:
            raise EngineError(refusal)
        with progress("Checking", len(items), log, "shards") as advance:
            found: list[list[str]] = []
            for problems in self.checker.check(items):
                found.append([problem.sentence for problem in problems])
                advance(1)
        return found

    def close(self) -> None:
        self.stack.close()
