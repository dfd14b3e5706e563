"""Remove old snapshots of a dataset, and temporary files that no process writes any more."""

import argparse
import json

from gen2d.cli.parser import Parser, add_dataset, add_network, limits
from gen2d.core.errors import one_line


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    parser.add_argument("--json", action="store_true", help="print the removed files as JSON")
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Remove the files of old snapshots; the exit code of the verb."""
    from gen2d.dataset import folder
    from gen2d.storage.paths import place
    from gen2d.storage.retries import Network

    root = place(options.dataset, Network(**limits(options)))
    removed = [str(name) for name in folder.clean(root)]
    if options.json:
        print(json.dumps({"dataset": f"{root}", "removed": removed}))
        return 0
    for name in removed:
        print(one_line(f"removed: {name}"))
    print(f"{root}: clean")
    return 0
