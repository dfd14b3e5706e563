"""The dataset card, README.md, from the manifest."""

from gen2d.dataset.hub import dataset_metadata, split_names
from gen2d.dataset.manifest import Manifest, statistics
from gen2d.dataset.spec import EARLIER_SCHEMA, PAGE, SHEET, shard_name, shard_of


def card_split(manifest: Manifest) -> str:
    """The split that the cards show and load."""
    return "train" if "train" in manifest.splits else min(manifest.splits)


def readme(manifest: Manifest, command: str) -> str:
    """The dataset card as Markdown; `command` is the command that made the dataset."""
    fields, first = manifest.fields, card_split(manifest)
    plugin = ", hdf5plugin" if manifest.codec == "zstd" else ""
    reads_rows = manifest.schema != EARLIER_SCHEMA
    lines = (f"| {name} | {f.dtype} | {f.axes} | {f.unit} | {f.meaning} |" for name, f in fields.items())
    shard = shard_of(first, 0, min(manifest.splits[first], manifest.videos_per_shard), manifest.videos_per_shard)
    return dataset_metadata(manifest) + _README.format(
        name=manifest.name,
        counts=", ".join(f"{count} {split}" for split, count in manifest.splits.items()),
        fps=manifest.fps,
        rows="\n".join(lines),
        sizes=", ".join(f"{axis} = {size}" for axis, size in sorted(manifest.sizes.items())),
        conventions=manifest.conventions,
        split=first,
        shard=shard_name(shard.name),
        sheet=f"\n![{_PICTURED}]({SHEET})\n" if SHEET in manifest.files else "",
        page=f"\n{_PAGE}\n" if PAGE in manifest.files else "",
        statistics="\n".join(f"| {' | '.join(row)} |" for row in statistics(manifest)),
        sampled=manifest.stats_sampled,
        field="frames" if "frames" in fields else min(fields),
        hub=_HUB.format(split=split_names(manifest.splits)[first], plugin=plugin) if reads_rows else "",
        plugin=plugin,
        command="` and `".join(f"{command} --n {n} --split {split}" for split, n in manifest.splits.items()),
        seed=manifest.seed,
        licence=manifest.licence or "None was chosen: choose one before publishing.",
    )


_PICTURED = "the first videos, time from left to right; below them annotations of the first"
_PAGE = f"""[{PAGE}]({PAGE}) plays the first videos in any browser, without a network: outlines, velocities, contacts,
trails, boxes and masks over the frames, the videos of a matched set side by side, energies and factors.
`python -m gen2d view .` shows all videos."""

_HUB = """With Hugging Face's `datasets`, also from the Hub, by the name of its repository (`streaming=True` downloads
videos as they are read; each row also has the fields that all videos share, and gen2d's own `chunk_index`):

```python
import datasets, os{plugin}
dataset = datasets.load_dataset(os.path.abspath("."), split="{split}")
video = dataset.with_format("numpy")[0]
```

"""

# The folder is `.` in the examples, as a copy may have another name.
_README = """# {name}

Rendered videos of two-dimensional rigid bodies with everything that is true about them: {counts} videos,
{fps:g} frames per second.
{sheet}{page}
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
loader = gen2d.DataLoader(dataset, batch_size=32, to="jax", epochs=1, drop_last=False)
for batch in loader:
    means = jax.tree.map(jax.numpy.mean, batch)
```

{hub}With h5py alone:

```python
import h5py{plugin}
file = h5py.File("{shard}")
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
