"""Show which options, fields and programs differ between two datasets or configs."""

import argparse
import json

from gen2d.cli.parser import Parser, add_network, limits
from gen2d.core.errors import DamagedError, UserError

MAX_SOURCES = 5  # source files that are named, at most


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    for name in ("first", "second"):
        parser.add_argument(name, metavar="DIR|CONFIG", help="a dataset's folder or URL, or a config")
    parser.add_argument("--json", action="store_true", help="print the differences as JSON, an object per line")
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Print the differences; 1 if there are any, else 0, as `diff` of files does."""
    from gen2d.tools.compare import ABSENT, compare

    try:
        differences = compare(options.first, options.second, **limits(options))
    except DamagedError as error:  # whose exit code is that of a difference
        raise UserError(error) from None
    sources = 0
    for difference in differences:
        if options.json:
            values = {"kind": difference.kind, "name": difference.name}
            ends = {end: getattr(difference, end) for end in ("first", "second") if end != difference.lacking}
            print(json.dumps({**values, **ends, **({ABSENT: difference.lacking} if difference.lacking else {})}))
            continue
        sources += difference.kind == "source"
        if difference.kind != "source" or sources <= MAX_SOURCES:
            print(difference)
    if sources > MAX_SOURCES:
        print(f"{sources - MAX_SOURCES} more source files differ; --json names them")
    return 1 if differences else 0
