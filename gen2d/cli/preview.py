"""Draw a contact sheet and an animation of a dataset or a config."""

import argparse
import json
from pathlib import Path

from gen2d.cli.parser import Parser, add_images, add_network, add_overrides, add_trust, limits, whole_number


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "source",
        metavar="DIR|CONFIG",
        help="a dataset's folder or URL, or a config; with --gallery also 'all', for every scene family",
    )
    parser.add_argument(
        "--out", type=Path, default=Path(), metavar="FOLDER", help="where to write pictures (default: current folder)"
    )
    parser.add_argument(
        "--videos",
        type=whole_number,
        metavar="K",
        help="how many videos to draw (default: 8; with --gallery 1, in each look)",
    )
    parser.add_argument(
        "--gallery", action="store_true", help="draw the same videos in every look and with every annotation instead"
    )
    parser.add_argument("--seed", type=whole_number, metavar="S", help="the seed of a config's videos")
    add_overrides(parser)
    add_trust(parser)
    parser.add_argument("--json", action="store_true", help="print the paths of the pictures as JSON")
    add_images(parser)
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Write pictures of a dataset or config; the exit code of the verb."""
    keywords = {"seed": options.seed, "overrides": options.overrides, "trust": options.trust, **limits(options)}
    if options.videos is not None:
        keywords["videos"] = options.videos
    if options.gallery:
        from gen2d.tools.gallery import families, gallery

        every = options.source == "all"
        paths = families(options.out, **keywords) if every else [gallery(options.source, options.out, **keywords)]
    else:
        from gen2d.tools.preview import preview

        paths = preview(options.source, options.out, **keywords)
    print(json.dumps({"files": [*map(str, paths)]}) if options.json else "\n".join(map(str, paths)))
    return 0
