"""A folder holds whole shards of one dataset or nothing, and its bytes follow from what is stored."""

import contextlib
import dataclasses
import errno
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose, assert_array_equal

import gen2d
from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset import hdf5
from gen2d.dataset.block import Block, encode, head
from gen2d.dataset.folder import clean, free_bytes, log, open_folder
from gen2d.dataset.manifest import read_manifest
from gen2d.dataset.records import read_records, remove_logs
from gen2d.dataset.spec import EARLIER_SCHEMA, IDENTITY, DatasetSpec, plan, shards_of_worker
from gen2d.generation.complete import complete
from gen2d.storage import codecs
from gen2d.storage.leases import lease
from gen2d.storage.sealed import as_json, seal

CODECS = pytest.mark.parametrize("codec", codecs.CODECS)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 100])
@pytest.mark.parametrize("size", [1, 8])
def test_a_plan_covers_each_video_once(count: int, size: int) -> None:
    planned = plan({"train": count, "val": 3}, size)
    covered = [(s.split, s.first + row) for s in planned for row in range(s.count)]
    assert covered == [("train", i) for i in range(count)] + [("val", i) for i in range(3)]
    assert len({s.name for s in planned}) == len(planned)
    assert all(s.count == size for s in planned if s.first + s.count < {"train": count, "val": 3}[s.split])


def test_workers_share_the_plan_whatever_is_done() -> None:
    planned = plan({"train": 50}, 4)
    remaining = planned[4:]
    shares = [shards_of_worker(remaining, worker, 3) for worker in range(3)]
    assert sorted(s.place for share in shares for s in share) == [s.place for s in remaining]
    assert shares[1] == [s for s in shards_of_worker(planned, 1, 3) if s in remaining]


@CODECS
def test_every_field_is_read_back(tmp_path: Path, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "toy", codec=codec))
    for shard in plan(made.splits, made.videos_per_shard):
        shared = {name: np.stack([values] * shard.count) for name, values in made.constants.items()}
        expected = synthetic.columns(made, shard) | shared
        found = hdf5.read(tmp_path / "toy" / "shards" / f"{shard.name}.h5")
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            assert_array_equal(found[name], values)
            assert found[name].dtype == np.dtype(made.fields[name].dtype)


@pytest.mark.parametrize("codec", ["gzip", "none"])
def test_h5py_alone_reads_every_field(tmp_path: Path, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "toy", codec=codec))
    shard = plan(made.splits, made.videos_per_shard)[1]
    with h5py.File(tmp_path / "toy" / "shards" / f"{shard.name}.h5") as file:
        for name, values in synthetic.columns(made, shard).items():
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            assert_array_equal(stored[()], values)
            about = {
                "axes": made.fields[name].axes,
                "unit": made.fields[name].unit,
                "meaning": made.fields[name].meaning,
            }
            assert dict(stored.attrs) == about
        assert file.attrs["conventions"] == made.conventions
        assert (file.attrs["split"], file.attrs["first"], file.attrs["fps"]) == (shard.split, shard.first, 10.0)


@CODECS
def test_the_index_says_where_the_bytes_are(tmp_path: Path, codec: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path, codec=codec))
    tables = {split: np.load(tmp_path / "index" / f"{split}-{count}.npy") for split, count in made.splits.items()}
    for shard in plan(made.splits, made.videos_per_shard):
        row, path = tables[shard.split][shard.place], tmp_path / "shards" / f"{shard.name}.h5"
        content = path.read_bytes()
        assert (row["first"], row["count"], row["bytes"]) == (shard.first, shard.count, len(content))
        with h5py.File(path) as file:
            stored = file["chunk_index"]
            assert isinstance(stored, h5py.Dataset)
            index = stored[()].view(read_manifest(tmp_path).video_type)[:, 0]
            assert stored.id.get_offset() == row["index"]
        for number, video in enumerate(index, shard.first):
            ((offset, size, crc),) = video["masks/instance"].tolist()
            data = content[offset : offset + size]
            mask = np.empty((5, 8, 8), np.uint8)
            codecs.decode_into(codec, data, mask)
            assert_array_equal(mask, synthetic.video(made, shard.split, number)["masks/instance"])
            assert codecs.crc32(data) == crc


@pytest.mark.parametrize("frames", [1, 2, 3, 6])
def test_a_chunk_holds_its_frames_and_the_index_says_where_it_is(tmp_path: Path, frames: int) -> None:
    sizes = {"T": 6, "H": 8, "W": 8, "K": 3}
    made = synthetic.make(synthetic.dataset(tmp_path, train=3, sizes=sizes, chunk_frames=frames))
    content = (tmp_path / "shards" / "train-00000-n3.h5").read_bytes()
    with h5py.File(io.BytesIO(content)) as file:
        index = np.asarray(file["chunk_index"]).view(read_manifest(tmp_path).video_type)[:, 0]
        assert_array_equal(file["frames"], [synthetic.video(made, "train", number)["frames"] for number in range(3)])
    for number, video in enumerate(index):
        assert len(video["frames"]) == 6 // frames
        for piece, (offset, size, crc) in enumerate(video["frames"].tolist()):
            data, found = content[offset : offset + size], np.empty((frames, 8, 8, 3), np.uint8)
            codecs.decode_into("gzip", data, found)
            expected = synthetic.video(made, "train", number)["frames"][piece * frames : (piece + 1) * frames]
            assert_array_equal(found, expected)
            assert codecs.crc32(data) == crc


@CODECS
def test_a_file_ends_where_its_superblock_says(tmp_path: Path, codec: str) -> None:
    """Room is reserved while it is written (HDF5 file format specification, superblock version 3: bytes 28 to 35)."""
    for made in (synthetic.dataset(tmp_path / "a", codec=codec), synthetic.small(tmp_path / "b", {"train": 20})):
        for path in (synthetic.folder(synthetic.make(made)) / "shards").iterdir():
            content = path.read_bytes()
            assert content[8] == 3
            assert int.from_bytes(content[28:36], "little") == len(content)


@CODECS
def test_bytes_depend_on_content_only(tmp_path: Path, codec: str) -> None:
    synthetic.make(synthetic.dataset(tmp_path / "a", codec=codec), size=1)
    if codec == "zstd":
        time.sleep(1.1)  # HDF5 counts whole seconds, where it is let
    synthetic.make(synthetic.dataset(tmp_path / "b", codec=codec), size=8)
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")


def test_head_is_what_encoding_fewer_gives(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    shard = plan(made.splits, 8)[1]
    some = encode(synthetic.columns(made, shard, range(3)), made.fields, "gzip")
    first = head(encode(synthetic.columns(made, shard), made.fields, "gzip"), 3)
    for part in ("arrays", "chunks", "crc", "moments"):
        for name, values in getattr(some, part).items():
            assert_array_equal(getattr(first, part)[name], values)


def test_statistics_are_of_what_is_stored(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    stats = read_manifest(tmp_path).stats["train"]
    videos = [synthetic.video(made, "train", number) for number in range(20)]
    frames = np.stack([video["frames"] for video in videos])[:, ::8, ::4, ::4].reshape(-1, 3)
    place = np.concatenate([video["states/position"][:, video["objects/present"]].reshape(-1, 2) for video in videos])
    for name, values in (("frames", frames), ("states/position", place)):
        for key in ("mean", "std", "min", "max"):
            found = stats[name][key]
            assert found is not None
            assert_allclose(found, getattr(values.astype(float), key)(0), rtol=1e-12)


def test_a_column_of_another_type_is_refused(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    columns = synthetic.columns(made, plan(made.splits, 8)[0])
    with pytest.raises(ValueError, match="states/angle is float64, but must be float32"):
        encode(columns | {"states/angle": columns["states/angle"].astype(float)}, made.fields, "gzip")


def test_a_column_of_another_shape_is_refused(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    shard = open_folder(made)[0]
    columns = synthetic.columns(made, shard)
    block = encode(columns | {"objects/mass": columns["objects/mass"][:, :1]}, made.fields, "gzip")
    with pytest.raises(ValueError, match=r"objects/mass has shape \(1,\) a video, but must have \(3,\)"):
        synthetic.write(made, shard, [block])


@pytest.mark.parametrize("videos", [7, 9])
def test_a_shard_of_another_count_is_refused(tmp_path: Path, videos: int) -> None:
    made = synthetic.dataset(tmp_path)
    shard = next(s for s in open_folder(made) if s.count == 8)
    blocks = synthetic.blocks(made, dataclasses.replace(shard, count=videos))
    with pytest.raises(ValueError, match="takes 8 videos"):
        synthetic.write(made, shard, blocks)
    assert not list((tmp_path / "shards").iterdir())


def test_what_is_done_is_not_made_again(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path)
    todo = open_folder(made)
    synthetic.write(made, todo[1], synthetic.blocks(made, todo[1]))
    assert not complete(made)
    assert open_folder(made) == [todo[0], *todo[2:]]
    synthetic.make(made)
    assert open_folder(made) == []


@pytest.mark.parametrize("damage", ["shard shorter", "shard gone", "row changed"])
def test_what_is_not_whole_is_made_again(tmp_path: Path, damage: str) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path, codec="zstd"))
    before = synthetic.tree(tmp_path)
    path = tmp_path / ("index/train-20.npy" if damage == "row changed" else "shards/train-00001.h5")
    content = bytearray(path.read_bytes())
    if damage == "shard gone":
        path.unlink()
    elif damage == "shard shorter":
        path.write_bytes(content[:-9])
    else:
        row = np.load(path).itemsize
        content[len(content) - 2 * row + 100] ^= 4  # in the second of three
        path.write_bytes(content)
    assert [shard.name for shard in open_folder(made)] == ["train-00001"]
    assert (tmp_path / "manifest.json").exists()
    synthetic.make(made)
    assert synthetic.tree(tmp_path) == before


def test_what_is_recorded_and_not_whole_is_made_again(tmp_path: Path) -> None:
    """A log that a crash cut in the middle of a row counts for the rows before it."""
    made = synthetic.dataset(tmp_path)
    todo = open_folder(made)
    for shard in todo[1:]:
        synthetic.write(made, shard, synthetic.blocks(made, shard))
    cut, longer, _ = sorted((tmp_path / ".gen2d" / "records").glob("train.*"))
    cut.write_bytes(cut.read_bytes()[:-9])
    longer.write_bytes(longer.read_bytes() + b"part of another")
    assert len(open_folder(made)) == 2
    synthetic.make(made)
    assert not list((tmp_path / ".gen2d" / "records").iterdir())
    found = synthetic.tree(tmp_path)
    synthetic.make(synthetic.dataset(tmp_path / "b"))
    assert synthetic.tree(tmp_path / "b") == found


def test_more_videos_extend_and_equal_one_run(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path / "a", train=12, codec="zstd"))
    first = (tmp_path / "a" / "shards" / "train-00000.h5").stat().st_mtime_ns
    longer = synthetic.dataset(tmp_path / "a", train=30, codec="zstd")
    assert [s.name for s in open_folder(longer)] == ["train-00001", "train-00002", "train-00003-n6"]
    synthetic.make(longer)
    synthetic.make(synthetic.dataset(tmp_path / "b", train=30, codec="zstd"))
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")
    assert (tmp_path / "a" / "shards" / "train-00000.h5").stat().st_mtime_ns == first


def test_fewer_videos_keep_what_is_there(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=20))
    before = synthetic.tree(tmp_path)
    fewer = synthetic.dataset(tmp_path, train=5)
    assert open_folder(fewer) == []
    assert complete(fewer)
    assert synthetic.tree(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 8}, "seed is 7 there and 8 here"),
        ({"config": {"scene": {"name": "toy", "balls": 4}, "fps": 10}}, "config.scene.balls is 3 there and 4 here"),
        ({"producer": {"fingerprint": {"jaxlib": "1", "batch_size": 8}}}, "fingerprint.jaxlib is 0 there and 1 here"),
        ({"codec": "zstd"}, "codec is gzip there and zstd here"),
    ],
)
@pytest.mark.parametrize("marked_by", [".gen2d", "manifest.json"])
def test_another_dataset_is_refused(tmp_path: Path, change: dict[str, Any], message: str, marked_by: str) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=3))
    if marked_by == ".gen2d":
        (tmp_path / "manifest.json").unlink()
    else:
        (tmp_path / ".gen2d").rename(tmp_path.parent / f"{tmp_path.name}-mark")
    before = synthetic.tree(tmp_path)
    with pytest.raises(FolderError, match="overwrite=True") as caught:
        open_folder(synthetic.dataset(tmp_path, train=3, **change))
    assert message in str(caught.value)
    assert synthetic.tree(tmp_path) == before


def test_every_hdf5_dataset_has_a_row_for_each_video(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path, chunk_frames=1))
    for shard in plan(made.splits, made.videos_per_shard):
        with h5py.File(tmp_path / "shards" / f"{shard.name}.h5") as file:
            names: list[str] = []
            file.visititems(lambda name, item, to=names: to.append(name) if isinstance(item, h5py.Dataset) else None)
            assert sorted(names) == sorted([*made.fields, "chunk_index"])
            for name in names:
                stored = file[name]
                assert isinstance(stored, h5py.Dataset)
                assert (stored.shape[0], stored.dtype.names) == (shard.count, None)
                assert str(stored.attrs["axes"]).split()[0] == "n"


def earlier(root: Path, **changes: Any) -> DatasetSpec:
    return synthetic.dataset(root, schema=EARLIER_SCHEMA, **changes)


def test_an_earlier_dataset_is_read_and_grows_in_its_own_schema(tmp_path: Path) -> None:
    """As one run of its version made it: the present spec, which does not know the schema, adds the same bytes."""
    whole, grown = earlier(tmp_path / "whole"), earlier(tmp_path / "grown", train=9)
    synthetic.make(whole)
    synthetic.make(grown)
    mark = json.loads((tmp_path / "grown" / ".gen2d" / "dataset.json").read_text())
    assert mark.keys() == {*IDENTITY, "sources", "identity_sha256"}  # as earlier versions wrote it
    with h5py.File(tmp_path / "grown" / "shards" / "train-00000.h5") as file:
        assert file.attrs["schema"] == EARLIER_SCHEMA
        assert np.asarray(file["time"]).shape == (5,)
        assert np.asarray(file["chunk_index"]).dtype == read_manifest(tmp_path / "grown").video_type
    found, new = gen2d.open(tmp_path / "grown", "train", "*")[:], synthetic.columns(whole, plan({"train": 9}, 16)[0])
    assert all(found[name].tobytes() == new[name].tobytes() for name in new)
    synthetic.make(synthetic.dataset(tmp_path / "grown"))
    assert synthetic.tree(tmp_path / "grown") == synthetic.tree(tmp_path / "whole")
    assert read_manifest(tmp_path / "grown").schema == EARLIER_SCHEMA
    assert gen2d.verify(tmp_path / "grown") == []


def test_an_earlier_dataset_that_was_begun_goes_on_in_its_own_schema(tmp_path: Path) -> None:
    begun = earlier(tmp_path / "begun")
    synthetic.write(begun, open_folder(begun)[0], synthetic.blocks(begun, plan(begun.splits, 8)[0]))
    synthetic.make(synthetic.dataset(tmp_path / "begun"))
    synthetic.make(earlier(tmp_path / "whole"))
    assert synthetic.tree(tmp_path / "begun") == synthetic.tree(tmp_path / "whole")


def test_an_earlier_dataset_that_is_overwritten_has_the_new_schema(tmp_path: Path) -> None:
    synthetic.make(earlier(tmp_path / "data"))
    synthetic.make(synthetic.dataset(tmp_path / "data"), overwrite=True)
    synthetic.make(synthetic.dataset(tmp_path / "new"))
    assert synthetic.tree(tmp_path / "data") == synthetic.tree(tmp_path / "new")


@pytest.mark.parametrize("schema", ["gen2d.dataset/2", "gen2d.dataset/5", None, 3])
def test_another_schema_is_neither_read_nor_added_to(tmp_path: Path, schema: Any) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path, train=3))
    manifest = json.loads((tmp_path / "manifest.json").read_text()) | {"schema": schema}
    (tmp_path / "manifest.json").write_bytes(as_json(seal(manifest, "manifest_sha256")))
    before = synthetic.tree(tmp_path)
    named = f"the schema {schema}" if isinstance(schema, str) else "an unknown schema"
    with pytest.raises(FolderError, match=f"has {named}, but this gen2d reads gen2d.dataset/4: make the dataset anew"):
        read_manifest(tmp_path)
    if isinstance(schema, str):
        with pytest.raises(FolderError, match=f"a dataset with {named}, but this gen2d writes gen2d.dataset/4"):
            open_folder(synthetic.dataset(tmp_path, train=20))
        assert synthetic.tree(tmp_path) == before
    synthetic.make(made, overwrite=True)
    assert read_manifest(tmp_path).splits == made.splits


def test_overwrite_replaces_a_dataset(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path / "a", train=20))
    synthetic.make(synthetic.dataset(tmp_path / "a", train=3, codec="zstd", seed=8), overwrite=True)
    synthetic.make(synthetic.dataset(tmp_path / "b", train=3, codec="zstd", seed=8))
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_no_dataset_is_left_alone(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FolderError, match="something other"):
        open_folder(synthetic.dataset(tmp_path), overwrite)
    with pytest.raises(FolderError, match=r"/thesis.tex is a file, not a folder"):
        open_folder(synthetic.dataset(tmp_path / "thesis.tex"), overwrite)
    with pytest.raises(FolderError, match=r"/thesis.tex is a file, not a folder"):
        open_folder(synthetic.dataset(tmp_path / "thesis.tex" / "toy"), overwrite)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(("code", "message"), [(errno.EACCES, "permission"), (errno.EROFS, "read-only")])
def test_a_folder_that_cannot_be_made_is_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, message: str
) -> None:
    def mkdir(path: Path, **_: object) -> None:
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(FolderError, match=message):
        open_folder(synthetic.dataset(tmp_path / "toy"))


def test_leftovers_of_the_dead_go_and_others_stay(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=3))
    names = ["a.h5.tmp.0123456789abcdef", "b.h5.tmp.0123456789abcdef", "c.h5.tmp.host.17"]
    (tmp_path / "shards" / names[0]).touch()
    (tmp_path / "shards" / names[2]).touch()
    with lease(tmp_path / "shards" / names[1]):
        open_folder(synthetic.dataset(tmp_path, train=3))
        assert [(tmp_path / "shards" / name).exists() for name in names] == [False, True, True]
    open_folder(synthetic.dataset(tmp_path, train=3))
    assert [(tmp_path / "shards" / name).exists() for name in names] == [False, False, True]


def test_what_is_complete_is_not_written_again(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path, train=12))

    def files() -> dict[str, int]:
        return {name: (tmp_path / name).stat().st_ino for name in synthetic.contents(tmp_path) if "lock" not in name}

    before = files()
    assert open_folder(made) == []
    assert complete(made)
    assert files() == before


def test_a_folder_that_is_a_link_is_not_written_into(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path / "data", train=3))
    (tmp_path / "data" / "shards").rename(tmp_path / "elsewhere")
    (tmp_path / "data" / "shards").symlink_to(tmp_path / "elsewhere")
    for action in (lambda: open_folder(made), lambda: clean(tmp_path / "data")):
        with pytest.raises(FolderError, match="shards is a link, but gen2d writes only into the dataset's own folders"):
            action()


def test_a_row_of_a_log_is_whole_or_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write may take a part of a row; if the disk is full then, the part is removed, so that others can follow."""
    made = synthetic.dataset(tmp_path)
    todo, write, full = open_folder(made), os.write, False

    def partial(descriptor: int, content: bytes) -> int:
        if full and len(content) < 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, content[:7])

    monkeypatch.setattr(os, "write", partial)
    with synthetic.ShardWriter(made) as writer:
        for number, shard in enumerate(todo):
            full = number == 1
            with pytest.raises(FolderError, match="no space left") if full else contextlib.nullcontext():
                writer.write(shard, synthetic.blocks(made, shard))
    assert open_folder(made) == [todo[1]]


def test_a_log_stays_while_a_worker_writes_it_or_a_row_of_it_is_nowhere_else(tmp_path: Path) -> None:
    made = synthetic.dataset(tmp_path, splits={"train": 20})
    todo = open_folder(made)
    with synthetic.ShardWriter(made) as other:
        other.write(todo[0], synthetic.blocks(made, todo[0]))
        known = read_records(made, tmp_path)
        with synthetic.ShardWriter(made) as writer:
            writer.write(todo[1], synthetic.blocks(made, todo[1]))
        remove_logs(made, known)
        assert open_folder(made) == todo[2:]
    remove_logs(made, known)
    assert open_folder(made) == [todo[0], *todo[2:]]
    remove_logs(made, read_records(made, tmp_path))
    assert open_folder(made) == todo


@pytest.mark.parametrize("raised", [ValueError, KeyboardInterrupt, SystemExit])
def test_nothing_half_written_stays(tmp_path: Path, raised: type[BaseException]) -> None:
    made = synthetic.dataset(tmp_path)
    shard = open_folder(made)[1]

    def failing() -> Iterator[Block]:
        yield next(synthetic.blocks(made, shard))
        raise raised

    with pytest.raises(raised):
        synthetic.write(made, shard, failing())
    assert not list((tmp_path / "shards").iterdir())
    assert not list((tmp_path / ".gen2d" / "records").iterdir())


# The limit on a file's size stands in for a full disk: HDF5 meets both in the same place.
FULL = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import synthetic
from gen2d.core.errors import UserError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
made = synthetic.dataset(Path({root!r}))
shard = synthetic.open_folder(made)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
try:
    synthetic.write(made, shard, synthetic.blocks(made, shard))
except UserError as error:
    print(error.exit_code, error)
"""


def test_a_write_that_the_disk_refuses_leaves_nothing(tmp_path: Path) -> None:
    script = FULL.format(tests=str(Path(synthetic.__file__).parent), root=str(tmp_path))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert re.fullmatch(r"1 .* cannot hold so large a file: .*ulimit -f.*same command again.*\n", done.stdout), done
    assert done.returncode == 0, done.stderr
    assert not list((tmp_path / "shards").iterdir())


def test_a_full_disk_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = synthetic.dataset(tmp_path)
    shard = open_folder(made)[1]

    def write(path: Path, *_: object) -> None:
        path.write_bytes(b"some")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(hdf5, "write", write)
    with pytest.raises(
        FolderError, match=r"no space left .* needs about .* MB left: make room.*same command again"
    ) as caught:
        synthetic.write(made, shard, synthetic.blocks(made, shard))
    assert caught.value.exit_code == 1
    assert not list((tmp_path / "shards").iterdir())


# Says when it has written half a shard, then waits to be killed.
KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
import synthetic
made = synthetic.dataset(Path({root!r}), codec={codec!r})
todo = synthetic.open_folder(made)
synthetic.write(made, todo[1], synthetic.blocks(made, todo[1]))
def slow():
    for block in synthetic.blocks(made, todo[2]):
        yield block
        print("half", flush=True)
        time.sleep(60)
synthetic.write(made, todo[2], slow())
"""


@CODECS
def test_a_killed_writer_publishes_nothing_and_is_resumed(tmp_path: Path, codec: str) -> None:
    script = KILLED.format(tests=str(Path(synthetic.__file__).parent), root=str(tmp_path / "a"), codec=codec)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stdout.readline() == b"half\n"
        process.send_signal(signal.SIGKILL)
    names = [path.name for path in (tmp_path / "a" / "shards").iterdir()]
    assert sorted(name for name in names if ".tmp." not in name) == ["train-00000.h5"]
    assert len(names) == 2
    synthetic.make(synthetic.dataset(tmp_path / "a", codec=codec))
    synthetic.make(synthetic.dataset(tmp_path / "b", codec=codec))
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")


# Three workers on a dataset that grows, killed together or one of them alone, at random moments, until 40 have been.
KILLING = """
import os, random, signal, sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
import synthetic
from gen2d.dataset.spec import shards_of_worker
def work(made, number):
    with synthetic.ShardWriter(made) as writer:
        for shard in shards_of_worker(synthetic.open_folder(made), number, 3):
            writer.write(shard, synthetic.blocks(made, shard))
    synthetic.complete(made)
fields = {{name: synthetic.FIELDS[name] for name in {fields!r}}}
chance, killed, count = random.Random(5), 0, 24
while killed < 40:
    made = synthetic.dataset(Path({root!r}), train=count, fields=fields)
    workers = []
    for number in range(3):
        workers.append(os.fork())
        if not workers[-1]:
            work(made, number)
            os._exit(0)
    time.sleep(chance.random() * 0.2)
    for worker in workers if chance.random() < 0.5 else [chance.choice(workers)]:
        os.kill(worker, signal.SIGKILL)
    killed += sum(os.WIFSIGNALED(os.waitpid(worker, 0)[1]) for worker in workers)
    for shard in made.root.glob("shards/*.h5"):
        synthetic.hdf5.read(shard)  # what has its name is whole
    count += 8 * chance.randint(0, 3)
print(count)
"""


def test_forty_kills_leave_no_trace(tmp_path: Path) -> None:
    names = (
        "frames",
        "index",
        "objects/mass",
        "time",
    )  # one of each kind: less to write, so that more of it is renaming
    script = KILLING.format(tests=str(Path(synthetic.__file__).parent), root=str(tmp_path / "a"), fields=names)
    count = int(subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout)
    fields = {name: synthetic.FIELDS[name] for name in names}
    synthetic.make(synthetic.dataset(tmp_path / "a", train=count, fields=fields))
    synthetic.make(synthetic.dataset(tmp_path / "b", train=count, fields=fields))
    assert synthetic.tree(tmp_path / "a") == synthetic.tree(tmp_path / "b")


def test_the_manifest_keeps_to_the_schema_and_to_itself(tmp_path: Path) -> None:
    made = synthetic.make(synthetic.dataset(tmp_path))
    manifest = read_manifest(tmp_path)
    assert manifest.plain["schema"] == manifest.schema == "gen2d.dataset/4"
    assert manifest.splits == {"train": 20, "test": 3}
    assert manifest.config == made.config
    assert socket.gethostname() not in json.dumps(manifest.plain)
    text = (tmp_path / "manifest.json").read_text()
    (tmp_path / "manifest.json").write_text(text.replace('"fps": 10.0', '"fps": 11.0'))
    with pytest.raises(DamagedError, match="not what was written"):
        read_manifest(tmp_path)


def test_the_log_takes_one_line_a_time(tmp_path: Path) -> None:
    open_folder(synthetic.dataset(tmp_path))
    log(tmp_path, {"speed": 1.5})
    log(tmp_path, {"speed": 2})
    lines = (tmp_path / ".gen2d" / "run.jsonl").read_text().splitlines()
    assert [json.loads(line)["speed"] for line in lines] == [1.5, 2]
    assert free_bytes(tmp_path / "not" / "yet") > 0
