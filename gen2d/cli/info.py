"""Show what a dataset holds: its splits, every field with its unit, statistics, and how it was made."""

import argparse

from gen2d.cli.parser import Parser, add_dataset, add_network, limits


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Print what a dataset or config holds; the exit code of the verb."""
    from gen2d.cli.report import info

    print(info(options.dataset, **limits(options)))
    return 0
