"""Show what a dataset holds: its splits, every field with its unit, statistics, and how it was made."""

import argparse
import json

from gen2d.cli.parser import Parser, add_dataset, add_network, limits


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    parser.add_argument("--json", action="store_true", help="print the dataset's manifest as JSON")
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Print what a dataset or config holds; the exit code of the verb."""
    if options.json:
        from gen2d.dataset.manifest import read_manifest
        from gen2d.storage.paths import place
        from gen2d.storage.retries import Network

        root = place(options.dataset, Network(**limits(options)))
        print(json.dumps({"dataset": f"{root}", **read_manifest(root).plain}))
        return 0
    from gen2d.cli.report import info

    print(info(options.dataset, **limits(options)))
    return 0
