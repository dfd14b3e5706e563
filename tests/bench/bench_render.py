"""Cost of rendering against the frame size and the number of objects: gen2d, OpenCV and a plain copy.

    python tests/bench/bench.py --only render --plot docs/render_cost.png  # 2 minutes, 5 with nothing compiled

The scene is that of configs/benchmark.yaml: N discs in a box of 10 m, 64 frames per video. Simulation is not timed.
gen2d renders in slices, as in a run; OpenCV is called from Python for every disc, as in peer.py, on the same states and
into a buffer of the size of a slice. Each turn renders 100 MB of frames, whatever their size. Times are CPU times of
this process on one core, so other work on the machine has little effect.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import peer
from charts import FAINT, cost_chart, save
from timing import first_batch, timed

FRAMES = 64  # of a video
SIZES = {64: 128, 128: 32, 256: 8}  # px: number of videos that are 100 MB


class Case(NamedTuple):
    """A frame size, a number of discs, and the number of videos rendered in a turn."""

    pixels: int
    objects: int
    videos: int

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{self.pixels} px, {self.objects} discs"

    @property
    def overrides(self) -> tuple[str, ...]:
        """Changes to configs/benchmark.yaml; many discs are smaller, so that they fit into the box."""
        video = [f"video.{name}={value}" for name, value in self.video.items()]
        radius = ["scene.radius=[0.25,0.5]"] if self.objects > 16 else []
        return *video, *radius, f"scene.balls={self.objects}", f"storage.batch_size={self.videos}"

    @property
    def video(self) -> dict[str, int]:
        """Section `video` of the config."""
        return {"frames": FRAMES, "height": self.pixels, "width": self.pixels}

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return self.pixels**2 * 3


CASES = {case.name: case for case in (Case(px, n, videos) for px, videos in SIZES.items() for n in (2, 8, 32))}
COPIED = "256 px, 8 discs"  # case that is compared with a copy
LIT = [f"{pixels} px, 8 discs" for pixels in (64, 256)]  # cases in which looks are compared, and the looks
LOOKS = {name: f"look={{name: {name}, wall_width: 3}}" for name in ("flat", "studio")}
SENSORS = {
    "no sensor": (),
    "vignette, exposure, white balance": ("vignette=0.3", "exposure_gain=0.5", "white_balance=0.3"),
    "noise": ("noise=2",),
    "shot noise": ("shot_noise=0.02",),
    "distortion": ("distortion=0.2",),
    "jpeg": ("jpeg_quality=75",),
}  # options of the section `image`, by name
SENSORS["all of them"] = tuple(option for options in SENSORS.values() for option in options)
SURFACES = {
    "studio": (),
    "masks": ("masks=true",),
    "masks, depth": ("masks=true", "depth=true"),
    "masks, normals": ("masks=true", "normals=true"),
    "shadow": ("shadow=true",),
}  # annotations of lit objects
ANNOTATED = Case(64, 8, 64)  # case in which annotations are measured
ANNOTATIONS = {
    "frames": (),
    "masks": ("masks=true",),
    "masks, boxes, visibility": ("masks=true", "boxes=true", "visibility=true"),
    "flow": ("flow=true",),
    "amodal": ("amodal=true",),
    "tracks, 8 points a slot": ("tracks=8",),
}


# ---- Renderers


def works(case: Case, rollout: Any) -> dict[str, Callable[[], float]]:
    """Functions by name that render, or copy, all frames of a case and return the CPU seconds per frame."""
    cv2.setNumThreads(1)
    batch = first_batch(rollout)
    columns = rollout.host_columns(batch)[0]
    buffer = np.zeros((rollout.slice, FRAMES, case.pixels, case.pixels, 3), np.uint8)
    source, target = (np.full(case.videos * FRAMES * case.frame_bytes, i, np.uint8) for i in range(2))

    def opencv() -> None:
        for video in range(case.videos):
            draw_discs(columns, video, buffer[video % len(buffer)])

    by_name = {"gen2d": _render_all(rollout, batch), "opencv": opencv, "copy": lambda: np.copyto(target, source)}
    return {name: timed(work, case.videos * FRAMES) for name, work in by_name.items()}


def annotation_works(rollouts: Mapping[str, Any]) -> tuple[dict[str, Callable[[], float]], dict[str, int]]:
    """By annotation, functions that render with it and return the CPU seconds per frame; its bytes per frame."""
    first = next(iter(rollouts.values()))
    batch, frames = first_batch(first), first.config.video.frames  # annotations do not affect the simulation
    works_by_name = {
        name: timed(_render_all(rollout, batch), first.batch_size * frames) for name, rollout in rollouts.items()
    }
    rendered = {name: rollout.draw(batch, 0, rollout.slice)[0] for name, rollout in rollouts.items()}
    sizes = {
        name: sum(array.nbytes for field, array in arrays.items() if field != "frames") // (first.slice * frames)
        for name, arrays in rendered.items()
    }
    return works_by_name, sizes


def frame_works(rollouts: Mapping[str, Any]) -> dict[str, Callable[[], float]]:
    """Functions by name that render all frames of a batch and return the CPU seconds per frame."""
    each = {name: (rollout, rollout.batch_size * rollout.config.video.frames) for name, rollout in rollouts.items()}
    return {name: timed(_render_all(rollout, first_batch(rollout)), frames) for name, (rollout, frames) in each.items()}


def _render_all(rollout: Any, batch: Any) -> Callable[[], None]:
    import jax

    def draw() -> None:
        for start in range(0, rollout.batch_size, rollout.slice):
            jax.block_until_ready(rollout.draw(batch, start, rollout.slice))

    return draw


def draw_discs(columns: Mapping[str, np.ndarray], video: int, frames: np.ndarray) -> None:
    """Render the discs of a video into frames [T, H, W, 3] uint8 by OpenCV."""
    radius, color, position = (columns[name][video] for name in ("objects/radius", "objects/color", "states/position"))
    discs = radius > 0  # walls have none
    peer.draw(position[:, discs], radius[discs], color[discs].tolist(), frames)


# ---- Results


class Drawing(NamedTuple):
    """A row of the table of rendering."""

    name: str
    pixels: int
    objects: int
    micros: Mapping[str, float]  # CPU time per frame, by renderer
    rates: Mapping[str, float]  # MB of frames per second, by renderer


class Annotated(NamedTuple):
    """A row of the table of annotations."""

    name: str
    micros: float  # CPU time of a frame with the annotation
    added: float  # part of it beyond the frame alone
    bytes: int  # of the annotation, per frame


LINES = {"gen2d": "gen2d", "opencv": "OpenCV, called from Python", "copy": "a copy of the frames"}


def drawing_of(case: Case, seconds: Mapping[str, float]) -> Drawing:
    """Row of the table, from the seconds per frame."""
    rates = {name: case.frame_bytes / value / 1e6 for name, value in seconds.items()}
    return Drawing(case.name, case.pixels, case.objects, {name: s * 1e6 for name, s in seconds.items()}, rates)


def table(drawings: Sequence[Drawing]) -> list[str]:
    """Lines of the table."""
    lines = ["one core, microseconds of CPU time a frame, and MB of frames a second"]
    lines += [f"{'':18} {'gen2d':>8} {'OpenCV':>8} {'a copy':>8} {'MB/s:':>7} {'gen2d':>7} {'OpenCV':>7} {'a copy':>7}"]
    for d in drawings:
        micros = " ".join(f"{d.micros[name]:8.2f}" for name in LINES)
        lines += [f"{d.name:18} {micros} {'':7} {' '.join(f'{d.rates[name]:7,.0f}' for name in LINES)}"]
    return lines


def table_of_annotations(rows: Sequence[Annotated]) -> list[str]:
    """Lines of the table."""
    lines = [f"one core, {ANNOTATED.name}, microseconds of CPU time a frame with an annotation, and its bytes"]
    lines += [f"{'':26} {'micros':>8} {'added':>8} {'bytes':>8}"]
    return lines + [f"{a.name:26} {a.micros:8.2f} {a.added:8.2f} {a.bytes:8,}" for a in rows]


COLORS = {"gen2d": "#114499", "opencv": "#dd6622"}
# The label of a line: index of its point, and alignment.
ENDS = {"gen2d": (0, "right"), "opencv": (-1, "left")}


def chart(drawings: Sequence[Drawing], path: Path) -> None:
    """Write a PNG chart of the cost of a frame against its side, with a line for each number of discs."""
    sizes = sorted({d.pixels for d in drawings})
    axes = cost_chart("Drawing on one core", "side of the frame, pixels", "microseconds a frame", sizes)
    for name, color in COLORS.items():
        end, side = ENDS[name]
        for count in sorted({d.objects for d in drawings}):
            points = [(d.pixels, d.micros[name]) for d in drawings if d.objects == count]
            axes.plot(*zip(*points, strict=True), "o-", color=color)
            offset = (-8 if side == "right" else 8, 0)
            axes.annotate(str(count), points[end], offset, textcoords="offset points", ha=side, va="center")
        axes.lines[-1].set_label(f"{LINES[name]}, N discs")
    least = min(d.micros[name] for d in drawings for name in COLORS)
    guide = [least * (size / sizes[0]) ** 2 for size in sizes]
    axes.plot(sizes, guide, color=FAINT, linewidth=1, label="pixels, slope only")
    save(axes, path)
