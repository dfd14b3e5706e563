"""Write a dataset as films, tar files, NumPy archives or in the layout of another program."""

import argparse
import dataclasses
import json
from pathlib import Path

from gen2d.cli.parser import (
    Parser,
    add_dataset,
    add_engine,
    add_images,
    add_network,
    add_overrides,
    add_trust,
    engine_of,
    limits,
    whole_number,
)
from gen2d.config.plugins import load, names
from gen2d.core.humanize import in_bytes, in_time


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    parser.add_argument(
        "--to", required=True, metavar="FORMAT", help=f"one of {', '.join(names('export'))}, or a Python file"
    )
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help="the folder or file to make (default: DIR-FORMAT, beside the dataset)"
    )
    parser.add_argument("--split", metavar="NAME", help="the split to export (default: the only one, or train)")
    parser.add_argument(
        "--fields",
        nargs="+",
        metavar="NAME",
        help="fields to export, by name or pattern such as 'states/*'; where the format can hold any (default: all)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an export of another dataset")
    sides = ("height", "H"), ("width", "W")
    for name, letter in sides:
        meaning = f"{name} in px of the frames, which are rendered again (default: that of the dataset)"
        parser.add_argument(f"--{name}", type=whole_number, metavar=letter, help=meaning)
    parser.add_argument("--look", metavar="NAME", help="look of the frames, which are rendered again")
    add_overrides(parser)
    parser.add_argument(
        "--select",
        metavar="CONDITIONS",
        help="export only videos such as 'factors/balls > 3 and factors/gravity[1] < -5'",
    )
    parser.add_argument("--codec", metavar="NAME", help=f"encoding of the frames: {_codecs()} (default: the first)")
    parser.add_argument(
        "--jobs", type=whole_number, metavar="N", help="threads that encode videos (default: one a core, 8 at most)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    add_trust(parser)
    add_engine(parser)
    add_images(parser)
    add_network(parser)


def _codecs() -> str:
    """The codecs of each format that has several."""
    formats = {name: load("export", name).codecs for name in names("export")}
    return "; ".join(f"{name} has {', '.join(codecs)}" for name, codecs in formats.items() if codecs)


def run(options: argparse.Namespace) -> int:
    """Export the videos; the exit code of the verb."""
    from gen2d.core.progress import to_stderr
    from gen2d.exports.export import export
    from gen2d.loading.dataset import RenderOptions

    keys = "height", "width", "look", "overrides"
    render = RenderOptions(**{key: value for key in keys if (value := getattr(options, key))})  # pyright: ignore
    exported = export(
        options.dataset,
        options.to,
        options.out,
        split=options.split,
        fields=options.fields,
        overwrite=options.overwrite,
        log=to_stderr,
        trust=options.trust,
        engine=engine_of(options),
        render=render or None,
        select=options.select,
        codec=options.codec,
        jobs=options.jobs,
        **limits(options),
    )
    if options.json:
        print(json.dumps(dataclasses.asdict(exported) | {"out": str(exported.out)}))
        return 0
    size = f"{in_time(exported.seconds)}, {in_bytes(exported.bytes)}"
    print(f"{exported.videos:,} videos in {size}, in {exported.out}")
    if exported.loss:
        print(f"{options.to} is {exported.loss}")
    return 0
