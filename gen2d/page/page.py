"""The bytes of a page: template, style, script and data in one HTML file."""

import base64
import hashlib
import html
import json
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.dataset.manifest import Manifest
from gen2d.dataset.readme import card_split
from gen2d.page.arrays import deflated
from gen2d.page.video import Detail, Videos
from gen2d.storage.paths import Place

VIDEOS = 24  # maximum number on a dataset's page
PAGE_BYTES = 980_000  # maximum size of a page, unless a single video is larger
FRAME_BYTES = 2**30  # of the shown videos before compression: they are decoded for the page
# Frames of a video and quality of WebP, None: lossless, best first. The search for the first that fits the page begins
# at START.
LADDER = ((64, None), (64, 80), (64, 50), (64, 35), (32, 60), (32, 35), (32, 20), (16, 20))
START = 2
PROBES = 3  # videos from which the size is estimated
SLACK = 1.08  # an estimate may be so much too large
SCRIPTS = ("page.js", "drawing.js", "player.js", "values.js", "gallery.js")  # one script, in this order
_FOLDER = Path(__file__).parent


def index_page(root: Place, manifest: Manifest) -> bytes:
    """Content of index.html: the first videos of a dataset, of which the manifest need not be in the folder yet.

    It is a function of the dataset. Raises the errors of `Dataset.batch`.
    """
    splits = {split: Videos(root, manifest, split) for split in _shown_splits(manifest)}
    numbers, budget = shown_videos(manifest), PAGE_BYTES - len(page(manifest, []))
    known: dict[tuple[str, int, int], dict[str, Any]] = {}

    def describe(split: str, number: int, rung: int) -> dict[str, Any]:
        key = split, number, rung
        if key not in known:
            known[key] = splits[split].video(number, _detail(*LADDER[rung]))
        return known[key]

    # Encoding a picture takes nearly all of the time, and leaves other threads running.
    with ThreadPoolExecutor(min(len(numbers), os.cpu_count() or 1, 4)) as pool:

        def described(some: list[tuple[str, int]], rung: int) -> list[dict[str, Any]]:
            return list(pool.map(lambda one: describe(one[0], one[1], rung), some))

        def fits(rung: int) -> bool:
            size = len(deflated(_as_json(described(probes, rung))))
            return size / len(probes) * len(numbers) <= SLACK * budget

        probes, rung = numbers[:: -(-len(numbers) // PROBES)], START
        if fits(START):
            while rung and fits(rung - 1):
                rung -= 1
        else:
            rung = next((rung for rung in range(START + 1, len(LADDER)) if fits(rung)), len(LADDER) - 1)
        while True:
            videos = described(numbers, rung)
            sizes = np.cumsum([len(deflated(_as_json(video))) for video in videos])
            count = max(1, int((sizes <= budget).sum()))
            if count == len(videos):
                return page(manifest, videos)
            if rung == len(LADDER) - 1:
                members = members_of(manifest)
                return page(manifest, videos[: count // members * members or count])
            rung += 1  # the probes were smaller than the others


def _detail(frames: int, quality: int | None) -> Detail:
    return Detail(frames, side=128, mask_side=64, quality=quality, objects=48, contacts=60)


def _shown_splits(manifest: Manifest) -> list[str]:
    """The splits of a page, that of the card first."""
    first = card_split(manifest)
    return [first, *(split for split in manifest.splits if split != first)][:VIDEOS]


def members_of(manifest: Manifest) -> int:
    """Number of videos in a matched set; 1 if there are none."""
    options = manifest.config.get("matched")
    members = options.get("members") if isinstance(options, dict) else None
    is_matched = "matched/set" in manifest.fields and type(members) is int
    return max(1, members) if is_matched and isinstance(members, int) else 1


def shown_videos(manifest: Manifest) -> list[tuple[str, int]]:
    """Split and number of the videos on a page: the first of each split, in whole matched sets if possible."""
    sizes, members = manifest.sizes, members_of(manifest)
    frame_bytes = 3 * sizes.get("T", 1) * sizes.get("H", 1) * sizes.get("W", 1) if "frames" in manifest.fields else 1
    most = max(1, min(VIDEOS, FRAME_BYTES // max(1, frame_bytes)))
    splits = _shown_splits(manifest)
    share = max(1, most // len(splits))
    share = share // members * members or min(members, most)
    counts = {split: min(manifest.splits[split], share) for split in splits}
    # What small splits leave over goes to the first one.
    spare = (most - sum(counts.values())) // members * members
    counts[splits[0]] = min(manifest.splits[splits[0]], counts[splits[0]] + max(0, spare))
    return [(split, number) for split in splits for number in range(counts[split])][:most]


def page(manifest: Manifest, videos: list[dict[str, Any]], **server: Any) -> bytes:
    """A page with these videos; `server` holds what a page of `gen2d view` needs to ask for others.

    A string of the dataset enters as escaped HTML text or in compressed JSON, of which the script sets texts alone. A
    policy in the page lets a browser run no script but that of gen2d.
    """
    script = "\n".join((_FOLDER / name).read_text("utf-8") for name in SCRIPTS)
    style = (_FOLDER / "page.css").read_text("utf-8")
    sizes, total = manifest.sizes, sum(manifest.splits.values())
    has_frames = "frames" in manifest.fields
    picture = f" of {sizes['W']} x {sizes['H']} px" if has_frames else ""
    data = {
        "fps": manifest.fps,
        "size": [sizes.get("W", 1), sizes.get("H", 1)],
        "splits": dict(manifest.splits),
        "members": members_of(manifest),
        "fields": {name: [field.unit, field.meaning] for name, field in manifest.fields.items()},
        "videos": videos,
        "server": server or None,
    }
    counts = ", ".join(f"{count:,} {split}" for split, count in manifest.splits.items())
    parts = {
        "policy": f"default-src 'none'; img-src data: blob:; script-src '{_hash(script)}'; style-src '{_hash(style)}'"
        + ("; connect-src 'self'" if server else ""),
        "name": manifest.name,
        "summary": f"{total:,} videos ({counts}): {sizes.get('T', 0)} frames{picture}, {manifest.fps:g} per second. "
        f"Seed {manifest.seed}.{'' if has_frames else ' No frames are stored: shapes are drawn from the states.'}",
        "licence": manifest.licence or "none chosen",
    }
    texts = {name: html.escape(text) for name, text in parts.items()}
    texts |= {"style": style, "script": script, "data": deflated(_as_json(data))}
    template = (_FOLDER / "page.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: texts[match[1]], template).encode("utf-8", "replace")


def _hash(text: str) -> str:
    """The hash of a script or style, as in a content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _as_json(values: object) -> bytes:
    return json.dumps(values, separators=(",", ":"), allow_nan=False).encode()
