"""Show all videos of a dataset, or a few of a config, in the browser."""

import argparse

from gen2d.cli.parser import Parser, add_network, add_overrides, limits, whole_number


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("source", metavar="DIR|CONFIG", help="a dataset's folder or URL, or a config")
    parser.add_argument(
        "--port", type=whole_number, metavar="P", help="the port on this machine (default: 8017; 0: any free one)"
    )
    parser.add_argument("--seed", type=whole_number, metavar="S", help="the seed of a config's videos")
    parser.add_argument("--json", action="store_true", help="print the address of the page as JSON")
    add_overrides(parser)
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; the exit code of the verb."""
    from gen2d.core.progress import inform, to_json
    from gen2d.tools.view import PORT, view

    log = to_json if options.json else inform
    port = PORT if options.port is None else options.port
    view(options.source, port, seed=options.seed, overrides=options.overrides, log=log, **limits(options))
    return 0
