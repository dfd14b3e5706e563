"""Pictures of the README's front: docs/front.webp, all families at once, and docs/families/NAME.webp, a loop of each.

    python tests/bench/front.py                  # all of them; half an hour on two cores
    python tests/bench/front.py pile chain       # the loops of these families

A family is rendered once in each of two looks, with masks and flow, at the size of its tile in front.webp. There, a
band of masks crosses the first look, and a band of flow the second. The same machine and versions give the same bytes.
"""

import argparse
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from gen2d.config.config import load_config
from gen2d.media.overlays import flow_overlay, masks_overlay
from gen2d.programs import devices
from gen2d.programs.source import VideoSource

DOCS = Path(__file__).parents[2] / "docs"
FRAMES, FPS = 64, 16  # of one pass of front.webp, and of each loop
GAP, GROUND = 4, (38, 40, 50)  # px between tiles, and their sRGB colour
BAND, SLANT = 0.34, 0.25  # width of a band over that of the picture, and its shift per height
DIM = 0.4  # brightness of frames under masks and flow
FRONT_BYTES, LOOP_BYTES = 2_000_000, 78_000  # largest sizes
QUALITIES = range(80, 20, -4)  # of WebP, tried in this order
KEY_FRAMES = 8  # frames between those that are stored whole, so that errors of others do not stay
BATCH = 8  # videos simulated at once
METALS, ALL = "material: metal", "material: [rubber, wood, metal, paper]"


class View(NamedTuple):
    """What is shown of a family: a video, its two looks, a part of its duration, and options."""

    video: int
    looks: tuple[str, str]  # YAML, without braces
    part: float = 1.0
    options: tuple[str, ...] = ()


VIEWS = {
    "bouncing": View(
        2, (f"name: studio, palette: paper, {ALL}", "name: flat, palette: dusk, wall_width: 3"),
        options=("scene.balls=8", "scene.radius=[0.6, 1.1]"),
    ),
    "pile": View(
        2, (f"name: studio, palette: lab, {ALL}", "name: marked, palette: okabe_ito, wall_width: 3"), 0.6,
        ("scene.discs=7", "scene.boxes=5", "scene.capsules=5", "scene.width=5", "scene.height=8",
         "scene.disc_radius=[0.35, 0.55]", "scene.box_size=[[0.6, 1], [0.6, 1]]", "scene.capsule_radius=[0.2, 0.3]",
         "scene.capsule_half_length=[0.3, 0.45]"),
    ),
    "galton": View(
        5, ("name: studio, palette: dusk", "name: flat, palette: paper, wall_width: 3"), 0.75,
        ("scene.balls=5", "scene.radius=0.26"),
    ),
    "marble_run": View(
        3, (f"name: studio, palette: paper, {METALS}", "name: outline, palette: dusk, wall_width: 3"), 0.9,
        ("scene.ramps=4", "scene.slope=[0.16, 0.22]", "scene.radius=[0.27, 0.3]"),
    ),
    "funnel": View(
        4, (f"name: studio, palette: lab, {ALL}", "name: shaded, palette: paper, wall_width: 3"), 0.75,
        ("scene.balls=12", "scene.gap=[1.1, 1.4]", "scene.radius=[0.4, 0.5]"),
    ),
    "pendulum": View(
        5, (f"name: studio, palette: dusk, {METALS}", "name: flat, palette: lab"),
        options=("scene.links=2", "scene.length=[1.2, 1.4]", "scene.radius=[0.42, 0.48]", "scene.angle=[1.6, 2.6]",
                 "scene.rod_radius=null"),
    ),
    "chain": View(
        0, (f"name: studio, palette: paper, {METALS}", "name: flat, palette: okabe_ito"),
        options=("scene.radius=[0.14, 0.17]", "scene.span=[0.6, 0.8]", "camera={center: [0, -1.3], scale: 25}"),
    ),
    "dominoes": View(
        1, ("name: studio, palette: dusk, material: wood", "name: flat, palette: paper, wall_width: 3"), 0.9,
        ("scene.dominoes=10", "scene.height=[1.5, 1.8]", "scene.thickness=[0.15, 0.25]", "scene.gap=[0.4, 0.8]",
         "scene.radius=[0.2, 0.3]", "scene.speed=[2, 4]"),
    ),
    "cradle": View(
        4, (f"name: studio, palette: lab, {METALS}", "name: marked, palette: dusk"), 0.85,
        ("scene.balls=5", "scene.moving_balls=2", "scene.radius=0.8", "scene.speed=[3, 4]"),
    ),
    "billiards": View(
        1, ("name: studio, palette: paper, background: [38, 112, 82], background_kind: gradient, "
            "background_to: [20, 78, 58], wall_width: 7", "name: textured, palette: lab, wall_width: 7"), 0.9,
        ("scene.rows=5", "scene.speed=[11, 14]"),
    ),
    "tower": View(
        4, ("name: studio, palette: paper, material: [wood, paper]", "name: flat, palette: dusk, wall_width: 3"),
        options=("scene.blocks=6", "camera={center: [-1.2, 3.1], scale: 20.5}"),
    ),
    "wrecking_ball": View(
        3, (f"name: studio, palette: dusk, {ALL}", "name: textured, palette: paper, wall_width: 3"), 0.9,
        ("scene.blocks=5", "scene.radius=[0.5, 0.6]", "scene.angle=[0.8, 1.4]", "scene.link_radius=null"),
    ),
    "seesaw": View(
        2, (f"name: studio, palette: lab, {ALL}", "name: flat, palette: okabe_ito, wall_width: 3"), 0.7,
        ("scene.weights=4", "scene.drop_height=[0.5, 1.5]"),
    ),
    "ramp": View(
        4, ("name: studio, palette: paper", "name: marked, palette: dusk, wall_width: 3"), 0.8,
        ("scene.radius=[0.55, 0.6]", "scene.slope=[0.45, 0.55]"),
    ),
    "parabola": View(
        3, ("name: studio, palette: dusk", "name: shaded, palette: lab"),
        options=("scene.radius=[0.9, 1]", "scene.speed=[6, 7]", "scene.angle=[0.9, 1.1]",
                 "scene.top_distance=[3.5, 5.5]"),
    ),
    "uniform_motion": View(
        4, ("name: studio, palette: lab", "name: marked, palette: paper"),
        options=("scene.radius=[1.2, 1.4]", "scene.speed=[3, 4]"),
    ),
    "collision": View(
        0, (f"name: studio, palette: dusk, {METALS}", "name: phyworld"),
        options=("scene.radius_1=[0.9, 1.3]", "scene.radius_2=[1, 1.5]"),
    ),
    "spinning": View(
        1, ("name: studio, palette: paper", "name: marked, palette: lab, wall_width: 3"), 0.9,
        ("scene.balls=3", "scene.radius=[0.7, 0.9]"),
    ),
    "hidden_mass": View(
        4, ("name: studio, palette: lab", "name: outline, palette: dusk, wall_width: 3"),
        options=("scene.pairs=2", "scene.radius=[0.6, 0.8]"),
    ),
    "occluder": View(
        5, (f"name: studio, palette: paper, {ALL}", "name: flat, palette: dusk, wall_width: 3"), 0.8,
        ("scene.balls=3", "scene.radius=[0.55, 0.7]", "scene.screen_width=[2.6, 3.2]"),
    ),
}  # fmt: skip

# Rows of front.webp: the height in px, and columns of families with their widths in px; those of a column share its
# height.
ROWS = (
    (128, (("bouncing", 128), ("pile", 92), ("galton", 76), ("marble_run", 88), ("funnel", 88), ("pendulum", 128),
           ("chain", 176))),
    (144, (("dominoes cradle", 288), ("billiards", 288), ("tower", 216))),
    (120, (("wrecking_ball", 168), ("seesaw", 208), ("ramp", 180), ("parabola", 116), ("uniform_motion", 112))),
    (120, (("collision", 252), ("spinning", 228), ("hidden_mass", 152), ("occluder", 156))),
)  # fmt: skip


class Tile(NamedTuple):
    """Place of a family in front.webp, in px."""

    left: int
    top: int
    width: int
    height: int


class Film(NamedTuple):
    """Frames [T, H, W, 3], uint8, of a family."""

    first: np.ndarray  # in its first look
    masks: np.ndarray  # black where nothing is
    second: np.ndarray  # in its second look
    flow: np.ndarray  # white where nothing moves


def tiles() -> dict[str, Tile]:
    """Place of each family."""
    found, top = {}, 0
    for height, columns in ROWS:
        left = 0
        for names, width in columns:
            stacked = names.split()
            own = (height - GAP * (len(stacked) - 1)) // len(stacked)
            for place, name in enumerate(stacked):
                found[name] = Tile(left, top + place * (own + GAP), width, own)
            left += width + GAP
        top += height + GAP
    return found


def film(family: str, tile: Tile, frames: int = FRAMES) -> Film:
    """A family's frames at the size of its tile; its whole part in `frames` frames."""
    view = VIEWS[family]
    plain = load_config(f"{family}.yaml").plain()
    seconds = plain["video"]["frames"] / plain["video"]["fps"] * view.part
    options = [
        f"video={{frames: {frames}, fps: {frames / seconds!r}, height: {tile.height}, width: {tile.width}}}",
        f"storage.batch_size={BATCH}",
        "storage.frames=video",
        *view.options,
    ]
    drawn = ["annotations.masks=true", "annotations.flow=true"]
    first = _fields(
        family, view, [*options, *drawn, f"look={{{view.looks[0]}}}"], ("frames", "masks/instance", "flow/forward")
    )
    second = _fields(family, view, [*options, f"look={{{view.looks[1]}}}"], ("frames",))
    speed = first["flow/forward"].astype(np.float32)
    speed[-1] = speed[-2:-1]  # the last frame has no next one
    speed /= max(float(np.quantile(np.hypot(speed[..., 0], speed[..., 1]).max((1, 2)), 0.8)), 1e-3)
    masks = masks_overlay(first)
    flow = np.stack([flow_overlay({"flow/forward": frame}) for frame in speed])
    return Film(first["frames"], masks, second["frames"], flow)


def _fields(family: str, view: View, options: Sequence[str], fields: Sequence[str]) -> dict[str, np.ndarray]:
    config = load_config(f"{family}.yaml", options)
    split = config.training.name if config.training else "train"
    source = VideoSource(config.of_split(split), devices.prepare()[:1])
    found = {name: np.asarray(array)[0] for name, array in source.videos(split, [view.video], fields).items()}
    jax.clear_caches()  # memory
    return found


def front(films: Mapping[str, Film], places: Mapping[str, Tile]) -> np.ndarray:
    """Frames [2 T, H, W, 3] of all families: in their first looks, then in their second ones, crossed by bands."""
    height = max(tile.top + tile.height for tile in places.values())
    width = max(tile.left + tile.width for tile in places.values())
    count = len(next(iter(films.values())).first)
    column = (np.arange(width) / width)[None, :] - SLANT * (np.arange(height) / height - 0.5)[:, None]
    column = column[..., None]
    pictures = []
    drawn = {name: (film.first, with_masks(film), film.second, with_flow(film)) for name, film in films.items()}
    for look in (0, 2):
        below, above = (_mosaic(drawn, places, part, (count, height, width)) for part in (look, look + 1))
        for t in range(count):
            # The band begins and ends outside of the picture.
            end = (1 + BAND + SLANT) * t / count - SLANT / 2
            pictures.append(np.where((column < end) & (column >= end - BAND), above[t], below[t]))
    return np.stack(pictures)


def with_masks(film: Film) -> np.ndarray:
    """Masks over the dimmed frames of the first look."""
    return np.where(film.masks.any(-1, keepdims=True), film.masks, dimmed(film.first))


def with_flow(film: Film) -> np.ndarray:
    """Flow over the dimmed frames of the second look, which show where flow is white."""
    white = film.flow.min(-1, keepdims=True) / 255
    return np.rint(film.flow - white * (255.0 - dimmed(film.second))).astype(np.uint8)


def dimmed(frames: np.ndarray) -> np.ndarray:
    """Dark, grey frames [..., 3], uint8."""
    grey = DIM * frames.mean(-1, keepdims=True)
    return np.broadcast_to(grey.astype(np.uint8), frames.shape)


def _mosaic(
    films: Mapping[str, Sequence[np.ndarray]], places: Mapping[str, Tile], part: int, size: tuple[int, int, int]
) -> np.ndarray:
    picture = np.full((*size, 3), GROUND, np.uint8)
    for name, own in films.items():
        left, top, width, height = places[name]
        picture[:, top : top + height, left : left + width] = own[part]
    return picture


def webp(frames: Iterable[np.ndarray], fps: float, most: int) -> bytes:
    """Animated WebP that loops, in the best quality of which it has at most `most` bytes, or in the least."""
    first, *others = [Image.fromarray(image) for image in frames]
    content = b""
    for quality in QUALITIES:
        file, duration = io.BytesIO(), round(1000 / fps)
        first.save(
            file, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=quality, method=4,
            minimize_size=False, kmin=KEY_FRAMES - 1, kmax=KEY_FRAMES,
        )  # fmt: skip
        content = file.getvalue()
        if len(content) <= most:
            break
    return content


def main() -> None:
    """Write the pictures that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("families", nargs="*", choices=[*VIEWS, []], metavar="FAMILY", help="default: all")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of the pictures (default: docs)")
    options = parser.parse_args()
    places, films = tiles(), {}
    (options.out / "families").mkdir(parents=True, exist_ok=True)
    for name in options.families or VIEWS:
        films[name] = film(name, places[name])
        _write(options.out / "families" / f"{name}.webp", webp(films[name].first, FPS, LOOP_BYTES))
    if not options.families:
        _write(options.out / "front.webp", webp(front(films, places), FPS, FRONT_BYTES))


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    print(f"{path}: {len(content):,} bytes", flush=True)


if __name__ == "__main__":
    main()
