"""List scene families, looks, annotations, formats of exports and configs, with all their options."""

import argparse

from gen2d.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="show only the plug-in or config of this name")


def run(options: argparse.Namespace) -> int:
    """Print the plug-ins and configs; the exit code of the verb."""
    from gen2d.cli.report import plugins

    print(plugins(options.name))
    return 0
