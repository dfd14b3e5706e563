"""A table of all objects, as CSV: a row for each object of each video.

Columns: video, slot, class, color_name, red, green, blue, static, x, y (px, in frame 0), radius, reach (m), mass (kg),
elasticity, friction.
"""

import csv
from pathlib import Path
from types import SimpleNamespace

from gen2d.plugin import STATIC, Export, Source, arrays, caption, facts

COLUMNS = ("video", "slot", "class", "color_name", "red", "green", "blue", "static", "x", "y", "radius", "reach")
MATERIAL = ("mass", "elasticity", "friction")


def write(target: Path, source: Source) -> None:
    """Write the file."""
    height, width = source.frame_size
    size = SimpleNamespace(fps=source.fps, height=height, width=width)
    with target.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow((*COLUMNS, *MATERIAL))
        for number, video in zip(source.numbers, source.videos(), strict=True):
            scene = facts.VideoFacts(video | dict(source.ds.manifest.constants), size)
            for slot, noun in scene.nouns.items():
                color = [int(part) for part in video["objects/color"][slot]]
                static = int(video["objects/kind"][slot] == STATIC)
                place = [round(float(part), 3) for part in scene.start[slot]]
                sizes = [f"{part:.6g}" for part in (video["objects/radius"][slot], scene.reach[slot])]
                rest = [f"{video[f'objects/{name}'][slot]:.6g}" for name in MATERIAL]
                word = caption.color_word(video, slot)
                table.writerow((source.key(number), slot, noun, word, *color, static, *place, *sizes, *rest))
            source.advance(1)


def check(source: Source) -> None:
    """Raise ConfigError for frames with lens distortion."""
    arrays.check_undistorted(source, "objects")


EXPORT = Export(
    fields=("objects/*", "states/*", "camera/*", "world/*"),
    write=write,
    check=check,
    fixed=True,
    suffix=".csv",
    loss="properties of the objects and their places in frame 0 alone",
)
