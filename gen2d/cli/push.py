"""Upload a dataset, or an export, to the Hugging Face Hub."""

import argparse
import dataclasses
import json

from gen2d.cli.parser import Parser
from gen2d.core.humanize import in_bytes, with_noun


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("folder", metavar="DIR", help="the folder of a dataset or of an export")
    parser.add_argument("repository", metavar="REPO", help="the dataset repository, NAME or OWNER/NAME")
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument("--licence", default="", metavar="NAME", help="licence in the card, such as cc-by-4.0")
    parser.add_argument("--branch", default="main", metavar="NAME", help="branch of the repository (default: main)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(options: argparse.Namespace) -> int:
    """Upload the folder; the exit code of the verb."""
    from gen2d.core.progress import to_stderr
    from gen2d.exports.upload import push

    given = {"private": options.private, "licence": options.licence, "branch": options.branch}
    pushed = push(options.folder, options.repository, **given, log=to_stderr)
    if options.json:
        print(json.dumps(dataclasses.asdict(pushed)))
        return 0
    removed = f", {with_noun(pushed.removed, 'old file')} removed" if pushed.removed else ""
    print(f"{with_noun(pushed.files, 'file')}, {in_bytes(pushed.bytes)}{removed}, in {pushed.url}")
    return 0
