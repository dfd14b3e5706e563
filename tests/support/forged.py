"""Datasets that somebody has changed and sealed again: every checksum fits, so only other checks can help."""

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset.croissant import croissant
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.rows import checks, npy_header, origin
from gen2d.dataset.spec import plan
from gen2d.storage import codecs


def as_text(value: Any) -> bytes:
    """JSON as gen2d writes it, and also what it never does."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False).encode("utf-8", "surrogatepass")


def seal(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the manifest, as a dictionary, and seals it."""
    path = root / "manifest.json"
    plain = json.loads(path.read_bytes())
    plain = change(plain) or plain
    rest = {key: value for key, value in plain.items() if key != "manifest_sha256"}
    path.write_bytes(as_text(rest | {"manifest_sha256": hashlib.sha256(as_text(rest)).hexdigest()}))
    with contextlib.suppress(DamagedError, FolderError):
        (root / "croissant.json").write_bytes(croissant(read_manifest(root)))


def replace_file(root: Path, name: str, content: bytes) -> None:
    """Another content for one of the files that the manifest has the hash of."""
    (root / name).write_bytes(content)
    seal(root, lambda plain: plain["files"].update({name: hashlib.sha256(content).hexdigest()}))


def change_rows(root: Path, split: str, change: Callable[[np.ndarray], Any]) -> None:
    """Changes the rows of a split's table, which then fit all the same."""
    manifest = read_manifest(root)
    table = manifest.tables[split]
    kind, header = manifest.shard_type, npy_header(manifest.shard_type, table.shards)
    rows = np.frombuffer((root / table.file).read_bytes(), kind, offset=len(header)).copy()
    change(rows)
    firsts = range(0, len(rows) * manifest.videos_per_shard, manifest.videos_per_shard)
    rows["check"] = checks(rows, origin(manifest.identity_sha256, split), firsts)
    put_table(root, manifest, split, header + rows.tobytes())


def put_table(root: Path, manifest: Manifest, split: str, content: bytes) -> None:
    """Another content for a table's file, which the manifest then names."""
    (root / manifest.tables[split].file).write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    seal(root, lambda plain: plain["tables"][split].update(sha256=digest))


def change_shard(root: Path, split: str, place: int, change: Callable[[bytearray, np.ndarray, np.void], Any]) -> None:
    """Changes a shard's file, the rows of its index, and its own row, and makes every checksum fit."""
    manifest = read_manifest(root)
    shard = plan({split: manifest.splits[split]}, manifest.videos_per_shard)[place]
    path = root / "shards" / f"{shard.name}.h5"

    def changed(rows: np.ndarray) -> None:
        content, row, kind = bytearray(path.read_bytes()), rows[place], manifest.video_type
        begin, size = int(row["index"]), shard.count * kind.itemsize
        index = np.frombuffer(bytes(content[begin : begin + size]), kind).copy()
        change(content, index, row)
        index["check"] = checks(
            index, origin(manifest.identity_sha256, split), range(shard.first, shard.first + len(index))
        )
        content[begin : begin + size] = index.tobytes()
        path.write_bytes(content)
        row["sha256"] = np.frombuffer(hashlib.sha256(content).digest(), np.uint8)
        row["bytes"] = len(content)

    change_rows(root, split, changed)


def flip_value(root: Path, split: str, place: int, field: str, video: int) -> None:
    """Another number in a field that is not compressed, of the shard's video with this row."""
    manifest = read_manifest(root)
    names = sorted(name for name, f in manifest.fields.items() if f.per_video and not f.is_image)
    size = manifest.row_bytes[names.index(field)]

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        begin = int(row["offsets"][names.index(field)]) + video * size
        content[begin] ^= 1
        index[field][video] = codecs.crc32(bytes(content[begin : begin + size]))

    change_shard(root, split, place, change)
