"""Snapshots of a dataset: how one manifest replaces another while readers of earlier ones read on."""

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path

from gen2d.core.errors import DamagedError, FolderError
from gen2d.dataset.manifest import Manifest, as_bytes, parse
from gen2d.dataset.records import Records, remove_logs
from gen2d.dataset.spec import (
    FILE_NAME,
    MANIFEST,
    NEXT,
    SNAPSHOTS,
    TABLE_NAME,
    DatasetSpec,
    shard_name,
    shard_of,
    snapshot_path,
)
from gen2d.storage.atomic import link_or_copy, list_folder, publish, publish_changed, remove_tree
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Place, Url
from gen2d.storage.sealed import JSON_BYTES, read_bytes


@dataclasses.dataclass(frozen=True)
class Publication:
    """The content of a snapshot apart from its shards and tables."""

    manifest: Manifest
    files: Mapping[str, bytes]  # config, plug-ins, sheet and cards to write, by name in the folder; others stay


class SupersededError(Exception):
    """Another process has published a snapshot meanwhile."""


def publish_snapshot(spec: DatasetSpec, publication: Publication, records: Records, old: Manifest | None) -> None:
    """Replace the manifest `old` by that of the publication.

    The old manifest moves to `.gen2d/snapshots`; once the new one is there, so do the files that only the old one
    names. A process killed at any moment leaves one manifest or the other, whole. Raises SupersededError, without
    changing what readers see, if the folder has another manifest than `old`.
    """
    root, new = spec.root, publication.manifest
    content = as_bytes(new)
    if old is not None and old.splits != new.splits:
        snapshot = snapshot_path(root, old.sha256)
        snapshot.mkdir(parents=True, exist_ok=True)
        publish_changed(snapshot / MANIFEST, as_bytes(old))
    if old is None or old.sha256 != new.sha256:
        publish(root / NEXT, content)
    for name, own in publication.files.items():
        if name == "README.md" and old is not None and old.sha256 == new.sha256 and (root / name).is_file():
            continue  # people may edit it
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        publish_changed(root / name, own)
    check_current(root, old)
    publish_changed(root / MANIFEST, content)
    (root / NEXT).unlink(missing_ok=True)
    _retire(root, new)
    remove_replaced(root, new, records)
    remove_logs(spec, records)


def current_manifest(root: Place) -> Manifest | None:
    """The folder's manifest; None if there is none that is intact."""
    return _intact_manifest(root / MANIFEST)


def next_manifest(root: Place) -> Manifest | None:
    """The manifest that a running or killed process was about to publish; None if there is none."""
    return _intact_manifest(root / NEXT)


def check_current(root: Place, expected: Manifest | None) -> None:
    """Check that the folder has this manifest; raises SupersededError."""
    current = current_manifest(root)
    if (current and current.sha256) != (expected and expected.sha256):
        raise SupersededError


def _intact_manifest(path: Place) -> Manifest | None:
    try:
        return parse(read_bytes(path, JSON_BYTES), f"{path}")
    except (FolderError, DamagedError):
        return None
    except OSError as error:
        failure = reading_error(path, error)
        if isinstance(failure, DamagedError):  # missing, or not a regular file
            return None
        raise failure from error


def _retire(root: Place, new: Manifest) -> None:
    """Move the files that only earlier manifests name into the folders of their snapshots."""
    snapshots: dict[str, list[Place]] = {}
    for folder in list_folder(root / SNAPSHOTS):
        earlier = _intact_manifest(folder / MANIFEST)
        if earlier is not None:
            for name in _growing_files(earlier) - _growing_files(new):
                snapshots.setdefault(name, []).append(snapshot_path(root, earlier.sha256))
    for name, folders in snapshots.items():
        source = root / name
        for target in (folder / name for folder in folders):
            if target.exists():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # it has been moved already
                if isinstance(source, Url) and isinstance(target, Url):
                    source.copy(target)
                elif isinstance(source, Path) and isinstance(target, Path):
                    link_or_copy(source, target)
        source.unlink(missing_ok=True)


def _growing_files(manifest: Manifest) -> set[str]:
    """The names of the files that are replaced when a split grows: its table, and a partial last shard."""
    names = {table.file for table in manifest.tables.values()}
    for split, count in manifest.splits.items():
        rest = count % manifest.videos_per_shard
        if rest:
            names.add(shard_name(shard_of(split, count - rest, rest, manifest.videos_per_shard).name))
    return names


def remove_replaced(root: Place, new: Manifest, records: Records) -> list[Place]:
    """Remove the leftovers of interrupted runs and return their paths: partial shards that are part of a larger shard
    in the manifest, and tables of splits that have grown since."""
    replaced: list[Place] = []
    for path in list_folder(root / "index"):
        match = TABLE_NAME.fullmatch(path.name)
        if match and int(match["count"]) < new.splits.get(match["split"], 0):
            replaced.append(path)
    if isinstance(root, Path):
        shards = list_folder(root / "shards")
    else:  # listing is slow at a URL
        shards = [root / shard_name(shard.name) for shard in records.shards() if shard.count < records.size]
    for path in shards:
        match = FILE_NAME.fullmatch(path.name)
        if match and match["count"]:
            end = int(match["place"]) * new.videos_per_shard + int(match["count"])
            if end < new.splits.get(match["split"], 0):
                replaced.append(path)
    for path in replaced:
        path.unlink(missing_ok=True)
    return replaced


def remove_snapshots(root: Place) -> list[Place]:
    """Remove all earlier snapshots and return their folders."""
    folders = list_folder(root / SNAPSHOTS)
    for folder in folders:
        remove_tree(folder)
    return folders
