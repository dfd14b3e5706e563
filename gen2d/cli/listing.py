"""List scene families, looks, annotations, formats of exports and configs; with a name or --options, their options."""

import argparse
import json

from gen2d.cli.parser import Parser
from gen2d.core.errors import UserError


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="show only the plug-in or config of this name")
    parser.add_argument("--options", action="store_true", help="show the options of all plug-ins and sections")
    parser.add_argument("--json", action="store_true", help="print all names as JSON; see also `config schema`")


def run(options: argparse.Namespace) -> int:
    """Print the plug-ins and configs; the exit code of the verb."""
    from gen2d.cli.report import catalogue, overview, plugins

    if options.json:
        if options.name or options.options:
            raise UserError("list --json prints names alone; options are in the output of config schema")
        print(json.dumps(catalogue()))
    else:
        print(plugins(options.name) if options.name or options.options else overview())
    return 0
