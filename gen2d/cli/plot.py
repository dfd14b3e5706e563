"""Plot energy, momentum, contacts and trajectories of a video, and the factors of a dataset."""

import argparse
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
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Write plots of a dataset; the exit code of the verb."""
    from gen2d.tools.plot import plot

    print(*plot(options.dataset, options.out, options.video, split=options.split, **limits(options)), sep="\n")
    return 0
