"""Completion of a dataset: tables, cards and page of its finished shards and, last, the manifest that readers open."""

from gen2d.core.errors import UnreachableError, UserError
from gen2d.dataset.croissant import croissant
from gen2d.dataset.folder import Sizes, folder_lock, is_done, translate_errors, whole_plan
from gen2d.dataset.manifest import Manifest, describe
from gen2d.dataset.manifest_parser import FILE_BYTES, ShardTable
from gen2d.dataset.readme import card_split, readme
from gen2d.dataset.records import Records, read_records
from gen2d.dataset.rows import npy
from gen2d.dataset.snapshots import Publication, SupersededError, publish_snapshot
from gen2d.dataset.spec import PAGE, SHEET, DatasetSpec, Shard, table_name
from gen2d.dataset.statistics import summarize
from gen2d.media import images
from gen2d.page.page import index_page
from gen2d.page.sheet import dataset_sheet, first_videos
from gen2d.storage.atomic import publish_changed
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Place
from gen2d.storage.sealed import has_sha256, sha256

ROWS = 4  # videos on a contact sheet


def complete(spec: DatasetSpec) -> bool:
    """Publish the dataset if all its shards are done, and return whether they are.

    False means that other workers are still generating shards. Raises UnreachableError if a server does not answer.
    """
    root = spec.root
    with translate_errors(root), folder_lock(root):
        while True:
            records, sizes = read_records(spec, root), Sizes(root)
            old = records.manifest
            shards = whole_plan(spec, records)
            if not all(is_done(shard, records, sizes) for shard in shards):
                return False
            try:
                publish_snapshot(spec, publication(spec, shards, records, old), records, old)
            except SupersededError:  # without locks another process may publish first: start from what it published
                continue
            return True


def publication(spec: DatasetSpec, shards: list[Shard], records: Records, old: Manifest | None) -> Publication:
    """Write the tables of these shards into the folder; return the manifest and other files of the snapshot.

    The manifest is `old` if that describes the same shards, whichever version of gen2d wrote it.
    """
    tables, rows = {}, {}
    for split in sorted({shard.split for shard in shards}):
        of_split = [shard for shard in shards if shard.split == split]
        rows[split] = records.table(split, of_split)
        content, name = npy(rows[split]), table_name(split, of_split[-1].first + of_split[-1].count)
        publish_changed(spec.root / name, content)
        sizes = rows[split]["bytes"].tolist()
        tables[split] = ShardTable(name, sha256(content), len(of_split), sum(sizes), max(sizes))
    counts = {shard.split: shard.first + shard.count for shard in shards}
    if old and (old.identity_sha256, old.splits, old.tables) == (spec.identity_sha256, counts, tables):
        current = _current_publication(spec, old)
        if current is not None:
            return current
    stats = {split: summarize(of_split["moments"], spec.fields) for split, of_split in rows.items()}
    files = spec.recipe_files
    hashes = {name: sha256(content) for name, content in files.items()}
    manifest = describe(spec, counts, tables, stats, hashes)
    pictures = {PAGE: index_page(spec.root, manifest)}
    if "frames" in spec.fields:
        pictures[SHEET] = sheet(spec.root, manifest)
    hashes |= {name: sha256(content) for name, content in pictures.items()}
    manifest = describe(spec, counts, tables, stats, hashes)
    return Publication(manifest, files | pictures | _cards(spec, manifest))


def _cards(spec: DatasetSpec, manifest: Manifest) -> dict[str, bytes]:
    return {"README.md": readme(manifest, spec.command).encode(), "croissant.json": croissant(manifest)}


def _current_publication(spec: DatasetSpec, old: Manifest) -> Publication | None:
    """The current manifest and the damaged files to rewrite; None if the content of one of them would differ."""
    recipe, files, pictures = spec.recipe_files, {}, {SHEET: sheet, PAGE: index_page}
    for name, digest in old.files.items():
        try:
            if has_sha256(spec.root / name, digest, FILE_BYTES):
                continue
        except OSError as error:
            failure = reading_error(spec.root / name, error)
            if isinstance(failure, UserError | UnreachableError):
                raise failure from error
        files[name] = pictures[name](spec.root, old) if name in pictures else recipe.get(name, b"")
        if sha256(files[name]) != digest:
            return None
    return Publication(old, files | _cards(spec, old))


def sheet(root: Place, manifest: Manifest) -> bytes:
    """Contact sheet of the first videos, as PNG; the manifest need not be in the folder yet."""
    split = card_split(manifest)
    return images.png(dataset_sheet(root, manifest, split, first_videos(manifest, split, ROWS)))
