"""A dataset at a URL is read and written as one in a folder is, also over a network that fails now and then."""

import errno
import gc
import json
import multiprocessing
import pickle
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import buckets
import numpy as np
import pytest
import s3fs
import synthetic
import tiny
from buckets import Request, Server
from fsspec.implementations.memory import MemoryFileSystem
from numpy.testing import assert_array_equal

import gen2d
from gen2d.core.errors import ConfigError, DamagedError, FolderError, UnreachableError, UserError
from gen2d.dataset import hdf5
from gen2d.dataset.folder import log, open_folder
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.records import read_tables
from gen2d.dataset.rows import origin, seal_rows
from gen2d.dataset.spec import DatasetSpec, shards_of_worker
from gen2d.generation.complete import complete
from gen2d.loading.dataloader import DataLoader
from gen2d.storage import filesystems, ranges, retries
from gen2d.storage.atomic import publish, sweep
from gen2d.storage.paths import Url, place, upload
from gen2d.storage.ranges import Range
from gen2d.storage.sealed import file_sha256, read_bytes

TOY = "s3://bucket/toy"


@pytest.fixture(scope="module")
def running() -> Iterator[Server]:
    with buckets.serving() as server, pytest.MonkeyPatch.context() as patch:
        for name, value in buckets.environment(server).items():
            patch.setenv(name, value)
        yield server
        filesystems._connect.cache_clear()
        s3fs.S3FileSystem.clear_instance_cache()
        gc.collect()  # closes connections


@pytest.fixture(autouse=True)
def server(running: Server, monkeypatch: pytest.MonkeyPatch) -> Server:
    monkeypatch.setattr(retries, "PAUSE", 0.01)
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)  # trying again is for gen2d
    running.reset()
    return running


@pytest.fixture(scope="module")
def toy(running: Server, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset in a folder, and at TOY, and on a web server."""
    root = tmp_path_factory.mktemp("data") / "toy"
    synthetic.make(synthetic.dataset(root))
    buckets.copy_dataset(root, TOY)
    running.folder = root.parent
    return root


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert_array_equal(found[name], values)


def first_time(kind: str) -> Callable[[Request], str]:
    """A fault that meets everything that is asked, once."""
    met: set[Request] = set()

    def fault(request: Request) -> str:
        fresh = request not in met
        met.add(request)
        return kind if fresh else ""

    return fault


def always(kind: str, method: str, part: str) -> Callable[[Request], str]:
    """A fault that meets this method and part of a path."""
    return lambda request: kind if request.method == method and part in request.path else ""


# ---- Reading


@pytest.mark.parametrize("cached", [False, True])
@pytest.mark.parametrize("kind", ["s3", "http", "file", "memory"])
def test_what_is_read_is_what_is_in_the_folder(
    server: Server, toy: Path, tmp_path: Path, kind: str, cached: bool
) -> None:
    urls = {"s3": TOY, "http": f"{server.address}/files/toy", "file": f"file://{toy}", "memory": "memory://some/toy"}
    if kind == "memory":
        for name, content in synthetic.tree(toy).items():
            (tmp_path / "one").write_bytes(content)
            upload(tmp_path / "one", Url(f"{urls[kind]}/{name}"))
    cache = tmp_path / "cache" if cached else None
    cases: list[dict[str, Any]] = [
        {"fields": "*"},
        {"window": 2, "start": 1, "stride": 2, "layout": "TCHW", "dtype": "float32"},
    ]
    for options in cases:
        found, expected = gen2d.open(urls[kind], cache_dir=cache, **options), gen2d.open(toy, **options)
        same(found[:], expected[:])
        same(found[[7, 0, 19, 7]], expected[[7, 0, 19, 7]])
        same(found[-1], expected[-1])


@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_every_codec_is_read(tmp_path: Path, codec: str) -> None:
    root = synthetic.folder(synthetic.make(synthetic.dataset(tmp_path / "toy", train=3, codec=codec)))
    buckets.copy_dataset(root, f"s3://bucket/{codec}")
    same(gen2d.open(f"s3://bucket/{codec}", "train", "*")[:], synthetic.stored(root))


def test_a_video_takes_one_request_a_field_and_near_ones_share(
    server: Server, toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = gen2d.open(TOY)  # frames and two fields of states
    dataset[:]  # so that it knows the index
    for near, one, neighbours in ((0, 3, 3), (ranges.NEAR, 1, 1)):
        monkeypatch.setattr(ranges, "NEAR", near)
        server.reset()
        dataset[3]
        assert len(server.requests) == len(server.of("GET", "/shards/train-00000.h5")) == one
        assert all(request.range for request in server.requests)
        server.reset()
        dataset[[4, 3, 3]]
        assert len(server.requests) <= neighbours + (near == 0)  # between the chunks of frames lie those of masks
    server.reset()
    dataset[:]
    assert len(server.requests) == 3  # one for each shard


def test_what_is_asked_covers_each_range_and_wastes_little() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        files, starts = random.integers(0, 3, 40), random.integers(0, 10**8, 40)
        sizes = random.choice([0, 10, 10**5, 10**7], 40)
        parts = zip(files.tolist(), starts.tolist(), sizes.tolist(), strict=True)
        wanted = [Range(Url(f"s3://bucket/{file}"), start, start + size) for file, start, size in parts]
        spans = ranges._spans(wanted)
        assert sorted({one for members in spans.values() for one in members}) == sorted(set(wanted))
        for span, members in spans.items():
            assert all(span.url == one.url and span.start <= one.start and one.end <= span.end for one in members)
            assert span.end - span.start <= ranges.LONGEST or span in members
            used = np.zeros(span.end - span.start, bool)
            for one in members:
                used[one.start - span.start : one.end - span.start] = True
            assert (~used).sum() <= ranges.NEAR * (len(members) - 1)


def test_the_index_is_fetched_when_it_is_needed_and_once(server: Server, toy: Path, tmp_path: Path) -> None:
    for cache, shards in ((None, 2), (tmp_path, 1)):  # the rows of the index lie in the shards
        dataset = gen2d.open(TOY, cache_dir=cache)
        assert not server.of("GET", "/index/")
        server.reset()
        same(dataset[5], gen2d.open(toy)[5])
        assert len(server.of("GET", "/index/")) == 1
        assert len(server.of("GET", "/shards/")) == shards
        server.reset()
        dataset[6]
        assert not server.of("GET", "/index/")
        assert len(server.of("GET", "/shards/")) == shards - 1
        same(pickle.loads(pickle.dumps(dataset))[5], gen2d.open(toy)[5])
        server.reset()


@pytest.mark.parametrize("kind", ["fail", "cut"])
def test_what_fails_is_tried_again(server: Server, toy: Path, tmp_path: Path, kind: str) -> None:
    for cache in (None, tmp_path):
        server.fault = first_time(kind)
        same(gen2d.open(TOY, cache_dir=cache)[:], gen2d.open(toy)[:])
        server.fault = first_time(kind)
        same(gen2d.open(f"{server.address}/files/toy", cache_dir=cache)[:], gen2d.open(toy)[:])


@pytest.mark.parametrize("cached", [False, True])
@pytest.mark.parametrize("kind", ["fail", "cut"])
def test_what_keeps_failing_is_an_error(server: Server, toy: Path, tmp_path: Path, kind: str, cached: bool) -> None:
    dataset = gen2d.open(TOY, cache_dir=tmp_path if cached else None)
    server.fault = always(kind, "GET", "/shards/train-00001.h5")
    with pytest.raises(UnreachableError, match=rf"{TOY}/shards/train-00001.h5 cannot be reached \(.+\)"):
        dataset[[1, 9]]
    same(dataset[1], gen2d.open(toy)[1])
    for part in ("manifest.json", "train-20.npy"):
        server.fault = always(kind, "GET", part)
        with pytest.raises(UnreachableError, match=rf"{TOY}/.*{part} cannot be reached \(.+\)$"):
            gen2d.open(TOY)[0]


def test_a_server_without_parts_is_an_error_and_a_cache_helps(server: Server, toy: Path, tmp_path: Path) -> None:
    url = f"{server.address}/files/toy"
    server.has_ranges = False
    try:
        with pytest.raises(FolderError, match="does not give parts of files: say cache_dir="):
            gen2d.open(url)[0]
        same(gen2d.open(url, cache_dir=tmp_path)[0], gen2d.open(toy)[0])
    finally:
        server.has_ranges = True


def damaged(toy: Path, url: str, name: str, change: Callable[[bytearray], Any]) -> None:
    """Puts a copy of the dataset at the URL, with one file changed."""
    buckets.copy_dataset(toy, url)
    content = bytearray((toy / name).read_bytes())
    change(content)
    s3fs.S3FileSystem().pipe(f"{url}/{name}", bytes(content))


def flip(content: bytearray) -> None:
    middle = len(content) // 2
    content[middle : middle + 6000] = bytes(6000)


def shorten(content: bytearray) -> None:
    del content[len(content) // 2 :]


@pytest.mark.parametrize("change", [flip, shorten])
def test_damage_is_never_returned_and_verify_tells_as_of_a_folder(
    toy: Path, tmp_path: Path, change: Callable[[bytearray], Any]
) -> None:
    url, name = f"s3://bucket/{change.__name__}", "shards/train-00001.h5"
    damaged(toy, url, name, change)
    for cache in (None, tmp_path / "cache"):
        with pytest.raises(DamagedError, match=rf"^{url}/{name}"):
            gen2d.open(url, fields="*", cache_dir=cache)[8:16]
    copy = tmp_path / "toy"
    for file, content in synthetic.tree(toy).items():
        (copy / file).parent.mkdir(parents=True, exist_ok=True)
        (copy / file).write_bytes(content)
    content = bytearray((copy / name).read_bytes())
    change(content)
    (copy / name).write_bytes(content)
    for level in ("quick", "full"):
        expected = [sentence.replace(str(copy), url) for sentence in gen2d.verify(copy, level)]
        assert gen2d.verify(url, level) == expected
    assert gen2d.verify(TOY, "full") == []


@pytest.mark.parametrize("change", [flip, shorten])
def test_a_damaged_index_is_an_error(toy: Path, change: Callable[[bytearray], Any]) -> None:
    url = f"s3://bucket/index-{change.__name__}"
    damaged(toy, url, "index/train-20.npy", change)
    with pytest.raises(DamagedError, match=rf"^{url}/index/train-20.npy"):
        gen2d.open(url)[19]


# ---- The cache


def sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in folder.iterdir()}


def test_a_cache_keeps_to_its_limit_and_drops_what_was_used_longest_ago(
    server: Server, toy: Path, tmp_path: Path
) -> None:
    rows = read_tables(toy, read_manifest(toy))["train"]
    hashes = [row["sha256"].tobytes().hex() for row in rows]
    limit = int(rows["bytes"][:2].sum()) + 20000
    dataset, expected = gen2d.open(TOY, cache_dir=tmp_path, cache_bytes=limit), gen2d.open(toy)
    for number in (0, 8, 1, 19):
        same(dataset[number], expected[number])
        assert sum(sizes(tmp_path).values()) <= limit
    assert hashes[1] not in sizes(tmp_path)
    assert {hashes[0], hashes[2]} <= sizes(tmp_path).keys()
    server.reset()
    dataset[[2, 18]]
    assert not server.requests
    random = np.random.default_rng(0)
    for number in random.integers(0, 20, 30):
        same(dataset[int(number)], expected[int(number)])
        assert sum(sizes(tmp_path).values()) <= limit


def test_what_is_changed_in_a_cache_is_fetched_again(server: Server, toy: Path, tmp_path: Path) -> None:
    gen2d.open(TOY, cache_dir=tmp_path)[:]
    for path in tmp_path.iterdir():
        content = bytearray(path.read_bytes())
        content[-1] ^= 1
        path.write_bytes(content if path.stat().st_size % 2 else content[:-9])
    (tmp_path / f"{'0' * 64}.part").write_bytes(b"of someone dead")
    same(gen2d.open(TOY, cache_dir=tmp_path)[:], gen2d.open(toy)[:])


def test_what_is_damaged_does_not_enter_the_cache(toy: Path, tmp_path: Path) -> None:
    url, name = "s3://bucket/uncached", "shards/train-00001.h5"
    damaged(toy, url, name, flip)
    with pytest.raises(DamagedError, match=rf"^{url}/{name} is not what was written: its sha256 differs"):
        gen2d.open(url, cache_dir=tmp_path)[8]
    assert all(path.name == file_sha256(path) for path in tmp_path.iterdir())


def read_slowly(folder: Path, numbers: list[int]) -> list[int]:
    return [int(gen2d.open(TOY, fields="index", cache_dir=folder)[number]["index"]) for number in numbers]


def test_processes_share_a_cache_and_fetch_each_shard_once(server: Server, toy: Path, tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        found = pool.starmap(read_slowly, [(tmp_path, [0, 9, 18, 1])] * 3)
    assert found == [[0, 9, 18, 1]] * 3
    assert len(server.of("GET", "/shards/")) == 3
    assert not list(tmp_path.glob("*.part"))


def test_a_killed_fetch_leaves_nothing_that_counts(server: Server, toy: Path, tmp_path: Path) -> None:
    words = "import sys, gen2d, time; ds = gen2d.open(sys.argv[1], cache_dir=sys.argv[2]); print(flush=True); ds[0]"
    with subprocess.Popen([sys.executable, "-c", words, TOY, tmp_path], stdout=subprocess.PIPE) as process:

        def killing(request: Request) -> str:
            if "/shards/" in request.path:
                process.kill()
            return ""

        server.fault = killing
        process.wait()
    server.reset()
    assert process.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob("*.part"))) == 1
    same(gen2d.open(TOY, cache_dir=tmp_path)[0], gen2d.open(toy)[0])
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"cache_bytes": 10**9}, "say cache_dir="), ({"cache_dir": "/tmp", "cache_bytes": 1000}, "for the largest shard")],
)
def test_a_cache_that_cannot_be_is_an_error(toy: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gen2d.open(TOY, **options)


# ---- Processes


READ_IN_OTHERS = """
import multiprocessing
import sys

import gen2d


def first_frames(dataset):
    return dataset[[0, 9]]["frames"]


if __name__ == "__main__":
    dataset = gen2d.open(sys.argv[1])
    expected = first_frames(dataset)  # so that the parent has connections open
    with multiprocessing.get_context(sys.argv[2]).Pool(2) as pool:
        assert all((frames == expected).all() for frames in pool.map(first_frames, [dataset] * 3))
"""


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_dataset_is_read_after_fork_and_spawn(toy: Path, tmp_path: Path, method: str) -> None:
    """In a process of its own: in this one, other libraries have threads, with which a fork may wait forever."""
    script = tmp_path / "script.py"
    script.write_text(READ_IN_OTHERS)
    subprocess.run([sys.executable, script, TOY, method], check=True, timeout=120)


def test_the_loader_takes_it(toy: Path) -> None:
    with (
        DataLoader(gen2d.open(TOY), 6, seed=3, epochs=2, num_threads=3) as found,
        DataLoader(gen2d.open(toy), 6, seed=3, epochs=2, num_threads=3) as expected,
    ):
        for one, other in zip(found, expected, strict=True):
            same(one, other)


def test_reading_a_folder_imports_no_fsspec_and_reading_a_url_no_jax(toy: Path) -> None:
    code = "import sys, gen2d; gen2d.open(sys.argv[1])[0]; assert not {'jax', sys.argv[2]} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code, toy, "fsspec"], check=True)
    subprocess.run([sys.executable, "-c", code, TOY, "h5py"], check=True)


# ---- Writing


def at(url: str, **changes: Any) -> DatasetSpec:
    return synthetic.dataset(place(url), **changes)


def test_what_is_written_is_what_is_in_the_folder_and_in_order(server: Server, toy: Path) -> None:
    synthetic.make(at("s3://bucket/written"))
    written = [request.path.removeprefix("/bucket/written/") for request in server.of("PUT")]
    assert buckets.tree("s3://bucket/written") == synthetic.tree(toy)
    assert written[-1] == "manifest.json"
    made = [
        path.rpartition(".")[0].partition(".1")[0] for path in written if path.startswith(("shards/", ".gen2d/rec"))
    ]
    kinds = ["shard" if path.startswith("shards/") else "record" for path in made]
    assert kinds == ["shard", "record"] * 4  # a shard is recorded when it is there
    assert not place("s3://bucket/written/.gen2d/records").exists()
    assert open_folder(at("s3://bucket/written")) == []
    log(place("s3://bucket/written"), {"speed": 1})
    log(place("s3://bucket/written"), {"speed": 2})
    lines = read_bytes(place("s3://bucket/written") / ".gen2d/run.jsonl", 1000).splitlines()
    assert [json.loads(line)["speed"] for line in lines] == [1, 2]


def test_many_shards_take_a_handful_of_requests(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    # Only the first shard is there, but the page would read 24 videos, each in its own shard.
    monkeypatch.setattr("gen2d.generation.complete.index_page", lambda root, manifest: b"page")
    url = "s3://bucket/many"
    fields = {name: synthetic.FIELDS[name] for name in ("index", "objects/mass", "time")}
    made = at(url, fields=fields, splits={"train": 3000}, videos_per_shard=1)
    todo = open_folder(made)
    with synthetic.ShardWriter(made) as writer:
        row = writer.write(todo[0], synthetic.blocks(made, todo[0]))
    rows = np.repeat(row, 2999)
    rows["first"] = np.arange(1, 3000)
    seal_rows(rows, origin(made.identity_sha256, "train"), rows["first"].tolist())
    for part in range(3):
        publish(place(f"{url}/.gen2d/records/train.{part:016x}.1"), rows[part::3].tobytes())
    server.reset()
    assert open_folder(made) == []
    assert len(server.requests) < 20
    server.reset()
    assert complete(made)
    assert len(server.requests) < 60
    server.reset()
    assert open_folder(made) == []
    assert len(server.requests) < 12
    server.reset()
    assert gen2d.open(url, fields="*")[0]["index"] == 0
    assert len(server.requests) < 6


def test_memory_takes_a_dataset_too(toy: Path) -> None:
    synthetic.make(at("memory://written"))
    same(gen2d.open("memory://written")[:], gen2d.open(toy)[:])
    assert gen2d.verify("memory://written", "full") == []


@pytest.mark.parametrize("kind", [pytest.param("fail", marks=pytest.mark.full), "cut"])
def test_uploads_are_tried_again(server: Server, toy: Path, kind: str) -> None:
    server.fault = first_time(kind)
    synthetic.make(at(f"s3://bucket/again-{kind}"))
    server.reset()
    assert buckets.tree(f"s3://bucket/again-{kind}") == synthetic.tree(toy)


def test_an_upload_of_which_a_part_arrives_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put, calls = MemoryFileSystem.put_file, list[str]()

    def partial(system: Any, source: str, target: str, **options: Any) -> None:
        put(system, source, target, **options)
        calls.append(target)
        if len(calls) == 1:
            system.pipe(target, b"part")

    monkeypatch.setattr(MemoryFileSystem, "put_file", partial)
    (tmp_path / "a").write_bytes(b"all of it")
    upload(tmp_path / "a", Url("memory://uploads/a"))
    assert len(calls) == 2
    assert Url("memory://uploads/a").read_bytes(100) == b"all of it"


@pytest.mark.parametrize("part", ["/shards/train-00001.h5", "/records/train."])
def test_an_upload_that_keeps_failing_is_an_error_and_is_resumed(server: Server, toy: Path, part: str) -> None:
    url = f"s3://bucket/failing{part.replace('/', '-')}"
    server.fault = always("fail", "PUT", part)
    with pytest.raises(UnreachableError, match=rf"^{url}/.*train.* cannot be reached .*same command again"):
        synthetic.make(at(url))
    server.reset()
    with pytest.raises(FolderError, match="is incomplete"):
        gen2d.open(url)
    assert "train-00001" in [shard.name for shard in open_folder(at(url))]
    synthetic.make(at(url))
    assert buckets.tree(url) == synthetic.tree(toy)


# Killed by the test as soon as the server is asked for what it waits for.
WRITING = """
import sys
sys.path.insert(0, sys.argv[1])
import synthetic
from gen2d.storage.paths import place
synthetic.make(synthetic.dataset(place(sys.argv[2])))
"""


@pytest.mark.parametrize("part", ["/shards/train-00001.h5", "/records/train.", "/index/train-20.npy"])
@pytest.mark.parametrize("arrives", [False, True])
def test_a_killed_writer_is_resumed(
    server: Server, toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str, arrives: bool
) -> None:
    url = f"s3://bucket/killed{part.replace('/', '-')}-{arrives}"
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    words = [sys.executable, "-c", WRITING, str(Path(synthetic.__file__).parent), url]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:

        def killing(request: Request) -> str:
            if request.method != "PUT" or part not in request.path:
                return ""
            process.kill()
            return "" if arrives else "fail"

        server.fault = killing
        process.wait()
    server.reset()
    assert process.returncode == -signal.SIGKILL
    with pytest.raises(FolderError, match="is incomplete"):
        gen2d.open(url)
    assert list(tmp_path.iterdir())
    sweep(place(url), ())
    assert not list(tmp_path.iterdir())
    synthetic.make(at(url))
    assert buckets.tree(url) == synthetic.tree(toy)


def test_more_videos_extend_and_equal_one_run(tmp_path: Path) -> None:
    synthetic.make(at("s3://bucket/longer", train=12))
    assert [shard.name for shard in open_folder(at("s3://bucket/longer", train=30))] == [
        "train-00001", "train-00002", "train-00003-n6",
    ]  # fmt: skip
    synthetic.make(at("s3://bucket/longer", train=30))
    synthetic.make(synthetic.dataset(tmp_path, train=30))
    assert buckets.tree("s3://bucket/longer") == synthetic.tree(tmp_path)


def test_workers_share_a_url(toy: Path) -> None:
    made = at("s3://bucket/shared")
    shares = [shards_of_worker(open_folder(made), worker, 2) for worker in range(2)]
    for share, is_last in zip(shares, (False, True), strict=True):
        for shard in share:
            synthetic.write(made, shard, synthetic.blocks(made, shard))
        assert complete(made) == is_last
    assert buckets.tree("s3://bucket/shared") == synthetic.tree(toy)


def test_another_dataset_is_refused_or_replaced(tmp_path: Path) -> None:
    url = "s3://bucket/another"
    synthetic.make(at(url))
    before = buckets.tree(url)
    with pytest.raises(FolderError, match="seed is 7 there and 8 here"):
        open_folder(at(url, seed=8))
    assert buckets.tree(url) == before
    synthetic.make(at(url, train=3, seed=8), overwrite=True)
    synthetic.make(synthetic.dataset(tmp_path, train=3, seed=8))
    assert buckets.tree(url) == synthetic.tree(tmp_path)


def test_what_is_no_dataset_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    upload(tmp_path / "thesis.tex", Url("s3://bucket/thesis/thesis.tex"))
    for overwrite in (False, True):
        with pytest.raises(FolderError, match="holds something other"):
            open_folder(at("s3://bucket/thesis"), overwrite)
    assert list(buckets.tree("s3://bucket/thesis")) == ["thesis.tex"]


@pytest.mark.parametrize("method", ["PUT", "GET"])
def test_no_permission_is_an_error(server: Server, toy: Path, method: str) -> None:
    server.fault = always("deny", method, "/")
    with pytest.raises(FolderError, match=r"s3://bucket/denied.* cannot be read or written \(permission denied\)"):
        synthetic.make(at("s3://bucket/denied"))
    if method == "GET":
        for call in (gen2d.open, gen2d.verify):
            server.fault = always("deny", method, "manifest.json" if call is gen2d.open else "/index/")
            with pytest.raises(FolderError, match=rf"^{TOY}/.* cannot be read: permission denied$"):
                call(TOY)


def test_a_full_disk_is_that_of_temporary_files(monkeypatch: pytest.MonkeyPatch) -> None:
    made = at("s3://bucket/full")
    shard = open_folder(made)[0]

    def write(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(hdf5, "write", write)
    with pytest.raises(FolderError, match=rf"^no space left for {tempfile.gettempdir()}: ") as caught:
        synthetic.write(made, shard, synthetic.blocks(made, shard))
    assert caught.value.exit_code == 1


# ---- The command line


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("s3://", "must be PROTOCOL://FOLDER"),
        ("nope://bucket/toy", r"Protocol not known: nope\); common protocols are"),
        ("s3://bucket/nothing-here", "not a (gen2d )?dataset"),
        ("s3://no-such-bucket/toy", "not a (gen2d )?dataset"),
        ("http://127.0.0.1:1/toy", r"http://127.0.0.1:1/toy/.* cannot be reached \("),
    ],
)
def test_a_wrong_url_is_one_sentence(url: str, message: str) -> None:
    with pytest.raises((UserError, UnreachableError), match=message):
        gen2d.open(url)
    for verb in ("verify", "info"):
        done = tiny.run_main(verb, url)
        assert done.returncode == (3 if "reached" in message else 2)
        assert re.fullmatch(rf"gen2d: .*{message}.*\n", done.stderr), done.stderr


@pytest.mark.parametrize(
    ("url", "missing"), [("s3://bucket/toy", "fsspec"), ("s3://bucket/toy", "s3fs"), ("memory://toy", "fsspec")]
)
def test_a_missing_package_is_one_sentence(url: str, missing: str) -> None:
    code = f"import sys; sys.modules[{missing!r}] = None; from gen2d.cli.main import main; "
    code += f"sys.exit(main(['info', {url!r}]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(r"gen2d: .* needs .*: pip install 'gen2d\[remote\]'\n", done.stderr), done.stderr


def test_a_run_leaves_at_a_url_what_it_leaves_in_a_folder(server: Server, tmp_path: Path) -> None:
    config = tmp_path / "tiny.yaml"
    config.write_text(json.dumps(tiny.CONFIG))
    for out in (tmp_path / "tiny", "s3://bucket/tiny"):
        done = tiny.run_command("--config", config, "--n", 12, "--out", out, "--device", "cpu")
        assert done.returncode == 0, done.stderr
        assert f"in {out}" in done.stdout
    assert buckets.tree("s3://bucket/tiny") == synthetic.tree(tmp_path / "tiny")
    for verb in ("verify", "info"):
        done = tiny.run_main(verb, "s3://bucket/tiny")
        assert done.returncode == 0, done.stderr
        assert "s3://bucket/tiny" in done.stdout
    done = tiny.run_main("preview", "s3://bucket/tiny", "--out", tmp_path, "--videos", 2)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "tiny-sheet.png").is_file()
    done = tiny.run_command("--config", config, "--n", 12, "--out", "s3://bucket/tiny", "--seed", 3, "--device", "cpu")
    assert done.returncode == 2
    assert "seed is 0 there and 3 here" in done.stderr
