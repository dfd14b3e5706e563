"""Gallery of the same videos in every look and with every annotation, and a page of all scene families.

The videos of a config are first generated without frames in a temporary folder, then rendered as those of a dataset.
"""

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.generation.run import generate
from gen2d.loading.dataset import Dataset
from gen2d.loading.dataset import open as open_dataset
from gen2d.media.contact_sheet import contact_sheet, resized, sheet_frames
from gen2d.media.drawing import label
from gen2d.media.images import check_folder, write, writing
from gen2d.media.overlays import (
    VideoFields,
    amodal_overlay,
    boxes_overlay,
    flow_overlay,
    height_overlay,
    masks_overlay,
    normals_overlay,
    shadow_overlay,
    tracks_overlay,
)
from gen2d.programs.recipe import config_of
from gen2d.programs.redraw import render
from gen2d.storage.sealed import sha256
from gen2d.tools.preview import check_videos, is_dataset

LABEL = 125  # px, width of a row's name
PAGE = 1000  # px, width of a row without its name, on the page of all families
TRACKS = 6  # track points per object


def gallery(
    source: str,
    out: Path,
    videos: int = 1,
    *,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    trust: Sequence[str] = (),
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> Path:
    """Write NAME-gallery.png into the folder `out`: the first videos in every look and with every annotation.

    The config's own look keeps its options, the others have their defaults. Returns the path. Parameters and errors are
    those of `preview`.
    """
    check_videos(videos)
    check_folder(out)
    if is_dataset(source):
        ds = open_dataset(source, timeout=timeout, deadline=deadline)
        looks = _looks(config_of(ds, overrides, trust).plain()["look"])
        image, name = _sheet(ds, videos, looks, overrides, trust), ds.manifest.name
    else:
        with _temporary_dataset(source, videos, seed, overrides) as (ds, plain, own_files):
            image, name = _sheet(ds, videos, _looks(plain["look"]), (), own_files), plain["name"]
    path = out / f"{name}-gallery.png"
    with writing(out):
        write(path, image)
    return path


def families(
    out: Path, videos: int = 1, *, seed: int | None = None, overrides: Sequence[str] = (), **_: object
) -> list[Path]:
    """Write families.png and FAMILY-gallery.png of every scene family into the folder `out`; return their paths.

    families.png shows the first videos of each family in the look of its config.
    """
    check_videos(videos)
    check_folder(out)
    rows, paths = [], []
    for name in plugins.names("scene"):
        has_config = f"{name}.yaml" in plugins.config_names()
        with _temporary_dataset(name if has_config else {"name": name, "scene": name}, videos, seed, overrides) as (
            ds,
            plain,
            own_files,
        ):
            frames = np.asarray(render(ds, range(videos), look=plain["look"], trust=own_files))
            rows.append(_add_label(name, _resize_to_page(contact_sheet(frames))))
            paths.append(out / f"{name}-gallery.png")
            with writing(out):
                write(paths[-1], _sheet(ds, videos, _looks(plain["look"]), (), own_files))
    with writing(out):
        write(out / "families.png", np.concatenate(rows))
    return [out / "families.png", *paths]


def _resize_to_page(sheet: np.ndarray) -> np.ndarray:
    """A sheet resized to the width of the page."""
    return resized(sheet, round(PAGE * sheet.shape[0] / sheet.shape[1]), PAGE)


@contextlib.contextmanager
def _temporary_dataset(
    source: str | Mapping[str, Any], videos: int, seed: int | None, overrides: Sequence[str]
) -> Iterator[tuple[Dataset, dict[str, Any], list[str]]]:
    """Temporary dataset of a config's first videos without frames, the plain config, and the sha256 of user files."""
    config = load_config(source, overrides)
    plain, split = config.plain(), config.training.name if config.training else "train"
    bare = plain | {"look": "flat", "annotations": {}, "storage": plain["storage"] | {"frames": "none"}}
    with tempfile.TemporaryDirectory() as folder:
        generate(bare, videos, Path(folder) / "states", seed=seed, split=split)
        yield open_dataset(Path(folder) / "states"), plain, [sha256(own) for own in config.copies.values()]


def _looks(own: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """All looks by their names in the gallery; the config's own look keeps its options."""
    return {name: {"name": name} for name in plugins.names("look")} | {Path(own["name"]).stem: own}


def _sheet(
    ds: Dataset, videos: int, looks: Mapping[str, Mapping[str, Any]], overrides: Sequence[str], trust: Sequence[str]
) -> np.ndarray:
    """Gallery [H, W, 3] of all looks and annotations."""
    numbers = range(min(videos, len(ds)))
    rows = [*_look_rows(ds, numbers, looks, overrides, trust), *_annotation_rows(ds, numbers, overrides, trust)]
    return np.concatenate([_add_label(name, contact_sheet(frames)) for name, frames in rows])


def _add_label(name: str, image: np.ndarray) -> np.ndarray:
    """An image with its name on a white strip at the left."""
    return np.concatenate([label([name], len(image), LABEL), image], axis=1)


Rows = Iterator[tuple[str, np.ndarray]]


def _look_rows(
    ds: Dataset,
    numbers: Sequence[int],
    looks: Mapping[str, Mapping[str, Any]],
    overrides: Sequence[str],
    trust: Sequence[str],
) -> Rows:
    """Name and frames [n, T, H, W, 3] of each look."""
    for name, look in looks.items():
        yield name, np.asarray(render(ds, numbers, look=look, overrides=overrides, trust=trust))


def _annotation_rows(ds: Dataset, numbers: Sequence[int], overrides: Sequence[str], trust: Sequence[str]) -> Rows:
    """Name of each annotation, and frames [n, T, H, W, 3] that show it."""
    overrides = [*overrides, f"annotations.tracks={TRACKS}"]
    fields = ["masks/instance", "masks/amodal", "boxes/visible", "boxes/amodal", "flow/forward", "tracks/points"]
    fields += ["tracks/visible", "frames"]
    yield from _overlaid(render(ds, numbers, look="flat", overrides=overrides, fields=fields, trust=trust), OVERLAYS)
    fields = ["surface/height", "surface/normal", "surface/shadow", "frames"]
    yield from _overlaid(render(ds, numbers, look="studio", overrides=overrides, fields=fields, trust=trust), SURFACES)


def _overlaid(batch: Mapping[str, Any], overlays: Mapping[str, Callable[[VideoFields], np.ndarray]]) -> Rows:
    """Names of overlays, and frames [n, T, H, W, 3] of rendered fields that show them."""
    times = sheet_frames(batch["frames"].shape[1])
    columns = {name: np.asarray(array[:, times]) for name, array in batch.items()}
    for name in columns.keys() & {"flow/forward", "surface/height"}:  # in parts of the largest value
        largest = np.abs(columns[name].astype(np.float32)).max()
        columns[name] = columns[name] / max(largest, 1e-3)
    videos, frames = columns["frames"].shape[:2]
    for name, overlay in overlays.items():
        drawn = [
            [overlay({field: array[video, t] for field, array in columns.items()}) for t in range(frames)]
            for video in range(videos)
        ]
        yield name, np.array(drawn)


SURFACES = {"depth": height_overlay, "normals": normals_overlay, "shadow": shadow_overlay}
OVERLAYS = {
    "masks": masks_overlay,
    "amodal": amodal_overlay,
    "boxes": boxes_overlay,
    "flow": flow_overlay,
    "tracks": tracks_overlay,
}
