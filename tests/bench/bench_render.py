"""What drawing costs against the size of the picture and the number of objects: gen2d, OpenCV and a plain copy.

    python tests/bench/bench.py --only render --plot renderers/render_cost.png  # 2 minutes, 5 with nothing compiled

The scene is that of configs/benchmark.yaml: N discs in a box of 10 m, 64 frames a video. It is simulated before any
time is taken. gen2d draws in slices as a run does; OpenCV is called from Python for every disc, as in peer.py, on the
same states and into a buffer of the size of a slice. A turn makes 100 MB of frames, whatever their size. Times are of
this process's CPU, which is on one core, so other work on the machine disturbs little.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import peer
from charts import FAINT, cost_chart, save
from timing import timed

FRAMES = 64  # of a video
SIZES = {64: 128, 128: 32, 256: 8}  # px, and how many videos are 100 MB


class Case(NamedTuple):
    """A size of picture, a number of discs, and how many videos are drawn in a turn."""

    pixels: int
    objects: int
    videos: int

    @property
    def name(self) -> str:
        """As it stands in the tables."""
        return f"{self.pixels} px, {self.objects} discs"

    @property
    def overrides(self) -> tuple[str, ...]:
        """What differs from configs/benchmark.yaml; many discs are smaller, so that they fit the box."""
        video = [f"video.{name}={value}" for name, value in self.video.items()]
        radius = ["scene.radius=[0.25,0.5]"] if self.objects > 16 else []
        return *video, *radius, f"scene.balls={self.objects}", f"storage.batch_size={self.videos}"

    @property
    def video(self) -> dict[str, int]:
        """The section `video` of its config."""
        return {"frames": FRAMES, "height": self.pixels, "width": self.pixels}

    @property
    def frame_bytes(self) -> int:
        """Of one frame."""
        return self.pixels**2 * 3


CASES = {case.name: case for case in (Case(px, n, videos) for px, videos in SIZES.items() for n in (2, 8, 32))}
COPIED = "256 px, 8 discs"  # what is held against a copy
ANNOTATED = Case(64, 8, 64)  # what annotations are added to
ANNOTATIONS = {
    "frames": (),
    "masks": ("masks=true",),
    "masks, boxes, visibility": ("masks=true", "boxes=true", "visibility=true"),
    "flow": ("flow=true",),
    "amodal": ("amodal=true",),
    "tracks, 8 points a slot": ("tracks=8",),
}


# ---- What draws


def works(case: Case, rollout: Any) -> dict[str, Callable[[], float]]:
    """By name what draws, or copies, all frames of a case and returns the CPU seconds of one."""
    cv2.setNumThreads(1)
    batch = rollout.start("train", np.tile(np.arange(rollout.batch_size), len(rollout.devices)))
    columns = rollout.host_columns(batch)[0]
    buffer = np.zeros((rollout.slice, FRAMES, case.pixels, case.pixels, 3), np.uint8)
    source, target = (np.full(case.videos * FRAMES * case.frame_bytes, i, np.uint8) for i in range(2))

    def opencv() -> None:
        for video in range(case.videos):
            drawn(columns, video, buffer[video % len(buffer)])

    by_name = {"gen2d": _drawing(rollout, batch), "opencv": opencv, "copy": lambda: np.copyto(target, source)}
    return {name: timed(work, case.videos * FRAMES) for name, work in by_name.items()}


def annotating(rollouts: Mapping[str, Any]) -> tuple[dict[str, Callable[[], float]], dict[str, int]]:
    """By annotation what draws videos with it and returns the CPU seconds of a frame, and the bytes of it a frame."""
    first = next(iter(rollouts.values()))
    batch = first.start(
        "train", np.tile(np.arange(first.batch_size), len(first.devices))
    )  # annotations change nothing of what is drawn from
    frames = first.config.video.frames
    each = {name: timed(_drawing(rollout, batch), first.batch_size * frames) for name, rollout in rollouts.items()}
    made = {name: rollout.draw(batch, 0, rollout.slice)[0] for name, rollout in rollouts.items()}
    told = {name: {of: array for of, array in arrays.items() if of != "frames"} for name, arrays in made.items()}
    return each, {
        name: sum(a.nbytes for a in arrays.values()) // (first.slice * frames) for name, arrays in told.items()
    }


def _drawing(rollout: Any, batch: Any) -> Callable[[], None]:
    import jax

    def draw() -> None:
        for start in range(0, rollout.batch_size, rollout.slice):
            jax.block_until_ready(rollout.draw(batch, start, rollout.slice))

    return draw


def drawn(columns: Mapping[str, np.ndarray], video: int, frames: np.ndarray) -> None:
    """Returns nothing; fills frames [T, H, W, 3] uint8 with a video's discs by OpenCV, as peer.drawn does."""
    height, discs = frames.shape[1], columns["objects/radius"][video] > 0  # walls have none
    scale, places = height / peer.SIDE, columns["states/position"][video][:, discs]
    pixels = np.stack([places[..., 0] * scale - 0.5, (peer.SIDE - places[..., 1]) * scale - 0.5], axis=-1)
    centers = np.rint(pixels * 2**peer.BITS).astype(int).tolist()
    radii = np.rint(columns["objects/radius"][video][discs] * scale * 2**peer.BITS).astype(int).tolist()
    colors = columns["objects/color"][video][discs].tolist()
    frames[:] = peer.BACKGROUND
    for frame, row in zip(frames, centers, strict=True):
        for center, radius, color in zip(row, radii, colors, strict=True):
            cv2.circle(frame, center, radius, color, -1, cv2.LINE_AA, peer.BITS)


# ---- What is told


class Drawing(NamedTuple):
    """A line of the table of drawing."""

    name: str
    pixels: int
    objects: int
    micros: Mapping[str, float]  # CPU time of a frame, by what draws it
    rates: Mapping[str, float]  # MB/s of frames


class Annotated(NamedTuple):
    """A line of the table of annotations."""

    name: str
    micros: float  # CPU time of a frame with it
    added: float  # of that, beyond the frame alone
    bytes: int  # of it a frame, beside the frame's own


LINES = {"gen2d": "gen2d", "opencv": "OpenCV, called from Python", "copy": "a copy of the frames"}


def drawing_of(case: Case, seconds: Mapping[str, float]) -> Drawing:
    """The line, from the seconds of a frame."""
    rates = {name: case.frame_bytes / value / 1e6 for name, value in seconds.items()}
    return Drawing(case.name, case.pixels, case.objects, {name: s * 1e6 for name, s in seconds.items()}, rates)


def table(drawings: Sequence[Drawing]) -> list[str]:
    """Lines of text."""
    lines = ["one core, microseconds of CPU time a frame, and MB of frames a second"]
    lines += [f"{'':18} {'gen2d':>8} {'OpenCV':>8} {'a copy':>8} {'MB/s:':>7} {'gen2d':>7} {'OpenCV':>7} {'a copy':>7}"]
    for d in drawings:
        micros = " ".join(f"{d.micros[name]:8.2f}" for name in LINES)
        lines += [f"{d.name:18} {micros} {'':7} {' '.join(f'{d.rates[name]:7,.0f}' for name in LINES)}"]
    return lines


def table_of_annotations(found: Sequence[Annotated]) -> list[str]:
    """Lines of text."""
    lines = [f"one core, {ANNOTATED.name}, microseconds of CPU time a frame with an annotation, and its bytes"]
    lines += [f"{'':26} {'micros':>8} {'added':>8} {'bytes':>8}"]
    return lines + [f"{a.name:26} {a.micros:8.2f} {a.added:8.2f} {a.bytes:8,}" for a in found]


COLORS = {"gen2d": "#114499", "opencv": "#dd6622"}
ENDS = {
    "gen2d": (0, "right"),
    "opencv": (-1, "left"),
}  # the point by which a line's number of discs stands, and its side


def chart(drawings: Sequence[Drawing], path: Path) -> None:
    """Write a chart of the cost of a frame against its side as a PNG file, a line for each number of discs."""
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
