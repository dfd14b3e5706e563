"""Plot energy, momentum, contacts and trajectories of a video, and the factors of a dataset."""

import argparse
import json
from pathlib import Path

from gen2d.cli.parser import Parser, add_dataset, add_network, limits, whole_number


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    parser.add_argument("--video", type=whole_number, default=0, metavar="I", help="the video's number (default: 0)")
    parser.add_argument("--split", metavar="NAME", help="the video's split (default: train, or the only one)")
    parser.add_argument(
        "--out", type=Path, default=Path(), metavar="FOLDER", help="where to write plots (default: current folder)"
    )
    parser.add_argument("--json", action="store_true", help="print the paths of the pictures as JSON")
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Write plots of a dataset; the exit code of the verb."""
    from gen2d.tools.plot import plot

    paths = plot(options.dataset, options.out, options.video, split=options.split, **limits(options))
    print(json.dumps({"files": [*map(str, paths)]}) if options.json else "\n".join(map(str, paths)))
    return 0
