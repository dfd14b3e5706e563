"""Manipulated datasets with valid checksums: only checks of the content can detect the change."""

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset.block import row_names
from gen2d.dataset.croissant import croissant
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.rows import npy_header, origin, row_checksums
from gen2d.dataset.spec import plan, shard_name
from gen2d.storage import codecs


def as_text(value: Any) -> bytes:
    """JSON in the format of gen2d, also of values that gen2d never writes."""
    return json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False).encode("utf-8", "surrogatepass")


def seal(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the manifest, as a dictionary, and update its hash and croissant.json."""
    path = root / "manifest.json"
    plain = json.loads(path.read_bytes())
    plain = change(plain) or plain
    body = {key: value for key, value in plain.items() if key != "manifest_sha256"}
    path.write_bytes(as_text(body | {"manifest_sha256": hashlib.sha256(as_text(body)).hexdigest()}))
    with contextlib.suppress(DamagedError, FolderError):
        (root / "croissant.json").write_bytes(croissant(read_manifest(root)))


def replace_file(root: Path, name: str, content: bytes) -> None:
    """Replace one of the files that the manifest lists, and update its hash."""
    (root / name).write_bytes(content)
    seal(root, lambda plain: plain["files"].update({name: hashlib.sha256(content).hexdigest()}))


def change_rows(root: Path, split: str, change: Callable[[np.ndarray], Any]) -> None:
    """Change the rows of a split's table and update their checksums."""
    manifest = read_manifest(root)
    table = manifest.tables[split]
    row_type, header = manifest.shard_type, npy_header(manifest.shard_type, table.shards)
    rows = np.frombuffer((root / table.file).read_bytes(), row_type, offset=len(header)).copy()
    change(rows)
    firsts = range(0, len(rows) * manifest.videos_per_shard, manifest.videos_per_shard)
    rows["check"] = row_checksums(rows, origin(manifest.identity_sha256, split), firsts)
    put_table(root, manifest, split, header + rows.tobytes())


def put_table(root: Path, manifest: Manifest, split: str, content: bytes) -> None:
    """Replace the file of a table and update its hash."""
    (root / manifest.tables[split].file).write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    seal(root, lambda plain: plain["tables"][split].update(sha256=digest))


def change_shard(root: Path, split: str, place: int, change: Callable[[bytearray, np.ndarray, np.void], Any]) -> None:
    """Change a shard's file, the rows of its index and its row in the table, and update every checksum.

    `change(content, index, row)` modifies its arguments in place; `place` is the number of the shard.
    """
    manifest = read_manifest(root)
    shard = plan({split: manifest.splits[split]}, manifest.videos_per_shard)[place]
    path = root / shard_name(shard.name)

    def update_row(rows: np.ndarray) -> None:
        content, row, index_type = bytearray(path.read_bytes()), rows[place], manifest.video_type
        offset, size = int(row["index"]), shard.count * index_type.itemsize
        index = np.frombuffer(bytes(content[offset : offset + size]), index_type).copy()
        change(content, index, row)
        index["check"] = row_checksums(
            index, origin(manifest.identity_sha256, split), range(shard.first, shard.first + len(index))
        )
        content[offset : offset + size] = index.tobytes()
        path.write_bytes(content)
        row["sha256"] = np.frombuffer(hashlib.sha256(content).digest(), np.uint8)
        row["bytes"] = len(content)

    change_rows(root, split, update_row)


def flip_value(root: Path, split: str, place: int, field: str, video: int) -> None:
    """Flip a bit of an uncompressed field, in row `video` of the shard with number `place`."""
    manifest = read_manifest(root)
    names = row_names(manifest.fields)
    size = manifest.row_bytes[names.index(field)]

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        offset = int(row["offsets"][names.index(field)]) + video * size
        content[offset] ^= 1
        index[field][video] = codecs.crc32(bytes(content[offset : offset + size]))

    change_shard(root, split, place, change)
