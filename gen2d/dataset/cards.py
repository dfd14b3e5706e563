"""What people and search engines read about a dataset: its README and its Croissant description, from the manifest."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from gen2d import preview
from gen2d.dataset.manifest import field_of, statistics
from gen2d.loading import dataset as loader
from gen2d.storage.atomic import as_json, sha256
from gen2d.storage.paths import Place

Manifest = Mapping[str, Any]

SHEET, ROWS = "sheet.png", 4  # the picture of a dataset with frames, and how many videos it shows


def picture(root: Place, manifest: Manifest) -> bytes:
    """A contact sheet of the first videos, as a PNG; the manifest need not be in the folder yet."""
    options = loader.Options(shown_split(manifest), ("frames",), None, 1, "first", "THWC", "uint8", "checksum")
    ds = loader.Dataset(root, manifest, options)
    # One video in memory at a time: they may be long and large.
    videos = (ds[number]["frames"] for number in range(min(ROWS, len(ds))))
    return preview.png(preview.contact_sheet(np.stack([preview.reduced(video) for video in videos])))


def shown_split(manifest: Manifest) -> str:
    """The split that cards show and load."""
    return "train" if "train" in manifest["splits"] else min(manifest["splits"])


def readme(manifest: Manifest, command: str) -> str:
    """The dataset's card; `command` is what made it."""
    splits, fields = manifest["splits"], manifest["fields"]
    lines = (f"| {name} | {a['dtype']} | {a['axes']} | {a['unit']} | {a['meaning']} |" for name, a in fields.items())
    return _README.format(
        name=manifest["name"],
        counts=", ".join(f"{count} {split}" for split, count in splits.items()),
        fps=manifest["fps"],
        rows="\n".join(lines),
        sizes=", ".join(f"{axis} = {size}" for axis, size in sorted(manifest["sizes"].items())),
        conventions=manifest["conventions"],
        split=shown_split(manifest),
        sheet=f"\n![the first videos, time from left to right]({SHEET})\n" if SHEET in manifest["files"] else "",
        statistics="\n".join(f"| {' | '.join(row)} |" for row in statistics(manifest)),
        sampled=manifest["stats_sampled"],
        field="frames" if "frames" in fields else min(fields),
        plugin=", hdf5plugin" if manifest["codec"] == "zstd" else "",
        command="` and `".join(f"{command} --n {n} --split {split}" for split, n in manifest["splits"].items()),
        seed=manifest["seed"],
        licence=manifest["licence"] or "None was chosen: choose one before publishing.",
    )


# The folder is `.` in the examples: its name may be another where it was copied to.
_README = """# {name}

Rendered videos of two-dimensional rigid bodies with everything that is true about them: {counts} videos,
{fps:g} frames per second.
{sheet}
## What it holds

| field | dtype | axes | unit | meaning |
|---|---|---|---|---|
{rows}

Sizes: n videos, {sizes}. {conventions}

## How to load it

`.` stands for this folder: run the examples in it, or say where it is.

With gen2d, as NumPy arrays:

```python
import gen2d
dataset = gen2d.open(".", split="{split}")
video = dataset[0]
```

With PyTorch:

```python
import gen2d, torch
dataset = gen2d.open(".", split="{split}")
loader = torch.utils.data.DataLoader(dataset, batch_size=32, shuffle=True)
batch = next(iter(loader))
```

With JAX, on its default device (`device=` and `sharding=` name others):

```python
import gen2d, jax
dataset = gen2d.open(".", split="{split}")
loader = gen2d.DataLoader(dataset, batch_size=32, to="jax", epochs=1, remainder="keep")
for batch in loader:
    means = jax.tree.map(jax.numpy.mean, batch)
```

With h5py alone:

```python
import h5py{plugin}
file = h5py.File("shards/{split}-00000.h5")
video = file["{field}"][0]
```

`manifest.json` describes every field and file, with checksums; `config.yaml` is the recipe.

## Statistics

| split | field | mean | standard deviation | least | largest |
|---|---|---|---|---|---|
{statistics}

One number for each channel or component, of {sampled}.

## How it was made

By `{command}` with seed {seed}. The same recipe, seed and versions make the same videos.

## Licence

{licence}
"""


def croissant(manifest: Manifest) -> dict[str, Any]:
    """The dataset in Croissant 1.0 (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": manifest["name"],
        "description": "Rendered videos of two-dimensional rigid bodies with full ground truth, made by gen2d.",
        "license": manifest["licence"],
        "version": "1.0.0",
        "variableMeasured": [_variable(name, about) for name, about in manifest["fields"].items()],
        "distribution": _files(manifest),
        "recordSet": [_shards()],
    }


def _variable(name: str, about: Mapping[str, Any]) -> dict[str, Any]:
    kind = {"valueReference": "sc:Text"} if field_of(about).is_text else {}
    told = {"name": name, "unitText": about["unit"], "description": about["meaning"]}
    return {"@type": "sc:PropertyValue"} | told | kind


def _files(manifest: Manifest) -> list[dict[str, Any]]:
    text = as_json(manifest)
    shards = (
        _file(f"shards/{shard['name']}.h5", "application/x-hdf5", shard["bytes"], shard["sha256"])
        for shard in manifest["shards"]
    )
    return [_file("manifest.json", "application/json", len(text), sha256(text)), *shards]


def _file(path: str, kind: str, size: int, digest: str) -> dict[str, Any]:
    about = {"@type": "cr:FileObject", "@id": path, "name": path, "contentUrl": path, "encodingFormat": kind}
    return about | {"contentSize": f"{size} B", "sha256": digest}


def _shards() -> dict[str, Any]:
    """The table of shards, which the manifest holds."""
    columns = {"name": "sc:Text", "split": "sc:Text", "first": "sc:Integer", "count": "sc:Integer"}
    return {
        "@type": "cr:RecordSet",
        "@id": "shards",
        "name": "shards",
        "description": "The HDF5 files, each with consecutive videos of one split.",
        "field": [_column(name, kind) for name, kind in columns.items()],
    }


def _column(name: str, kind: str) -> dict[str, Any]:
    source = {"fileObject": {"@id": "manifest.json"}, "extract": {"jsonPath": f"$.shards[*].{name}"}}
    return {"@type": "cr:Field", "@id": f"shards/{name}", "name": name, "dataType": kind, "source": source}


# The names that Croissant takes from its own and other vocabularies.
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
} | {name: f"cr:{name}" for name in ("extract", "field", "fileObject", "fileSet", "jsonPath", "recordSet", "source")}
