"""The command line: `python -m gen2d --config bouncing.yaml --n 100000`, and verbs for what a dataset needs later."""

import argparse
import dataclasses
import io
import json
import os
import secrets
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gen2d._version import __version__
from gen2d.core.errors import Error, UserError, one_line
from gen2d.storage.explain import reading_error
from gen2d.storage.paths import Network, Place, place, reading

VERBS = {
    "verify": "check a dataset against its checksums, or its recipe, and repair it",
    "info": "tell what a dataset holds",
    "list": "list scene families, looks, annotations, formats of exports and configs, with all options",
    "preview": "draw a contact sheet and an animation of a dataset or a config",
    "clean": "remove earlier snapshots of a dataset, and temporary files that nobody writes any more",
    "export": "write a dataset as films, tar files, NumPy archives or in another program's layout",
}

GUIDE = """\
what people do:
  python -m gen2d --config bouncing.yaml --n 1000            make 1000 videos in datasets/bouncing
  python -m gen2d --config bouncing.yaml --n 100000          make 99000 more: what is there stays
  python -m gen2d --config my.yaml --n 1000 --seed 7 --out /data/mine
  python -m gen2d --config bouncing.yaml --n 1000 --set video.height=128 --set video.width=128
  python -m gen2d preview bouncing.yaml                      look at it first

other verbs (each has its own --help):
"""


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence and exits with code 2; options are written out in full."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        fail(f"{message}; see {self.prog} --help", 2)


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def fail(sentence: str, code: int) -> NoReturn:
    """Ends the program with a sentence for a person."""
    print(f"gen2d: {sentence}", file=sys.stderr)
    raise SystemExit(code)


def generating() -> Parser:
    """The parser of the main job."""
    verbs = "\n".join(f"  python -m gen2d {name:<10} {what}" for name, what in VERBS.items())
    parser = Parser(
        prog="python -m gen2d",
        description="Make a dataset of rendered videos of 2D rigid bodies, with every ground truth.",
        epilog=GUIDE + verbs,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--config", required=True, metavar="YAML", help="a file, or the name of one that comes with gen2d"
    )
    parser.add_argument("--n", required=True, type=int, metavar="N", help="how many videos a split is to hold")
    parser.add_argument("--out", metavar="DIR", help="a folder or URL (default: datasets/NAME in the current folder)")
    parser.add_argument("--seed", type=int, metavar="S", help="0 to 2**63 - 1 (default: the config's, else 0)")
    parser.add_argument(
        "--split", metavar="NAME", help="the only split to make (default: train, or each that the config has)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=V",
        dest="overrides",
        help="override one option, such as physics.substeps=8",
    )
    parser.add_argument(
        "--device",
        default="auto",
        choices=("auto", "cpu", "gpu"),
        help="where to compute (auto: a GPU if there is one)",
    )
    parser.add_argument(
        "--worker", default="0/1", metavar="R/W", help="make every W-th shard, from the R-th on, beside other workers"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset of another config or seed")
    _add_network(parser)
    parser.add_argument("--version", action="version", version=f"gen2d {__version__}")
    return parser


def _verb_parser(verb: str) -> Parser:
    parser = Parser(prog=f"python -m gen2d {verb}", description=VERBS[verb].capitalize() + ".")
    if verb == "list":
        parser.add_argument("name", nargs="?", help="a family, look, annotation, format or config: only this one")
        return parser
    more = ", or a config; with --gallery also 'all': every scene family" if verb == "preview" else ""
    help_text = f"a dataset's folder or URL{more}"
    parser.add_argument("dataset", metavar="DIR" + ("|CONFIG" if verb == "preview" else ""), help=help_text)
    if verb == "verify":
        parser.add_argument(
            "--level",
            choices=("quick", "full", "regen"),
            default="full",
            help="quick: sizes and index; full: every byte; regen: also some videos made again and compared",
        )
        parser.add_argument("--videos", type=int, default=8, metavar="K", help="how many videos regen makes again (8)")
        parser.add_argument("--seed", type=int, metavar="S", help="chooses them (default: another one each time, told)")
        parser.add_argument("--repair", action="store_true", help="make what is wrong again, from the recipe")
        parser.add_argument("--json", action="store_true", help="print what was found and repaired as JSON")
    if verb == "export":
        _add_export(parser)
    if verb in ("verify", "preview", "export"):
        parser.add_argument(
            "--trust",
            action="append",
            default=[],
            metavar="SHA256",
            help="let a file of code that came with the dataset run, where one has to",
        )
    _add_network(parser)
    if verb == "preview":
        parser.add_argument(
            "--out", type=Path, metavar="FOLDER", help="where to put the pictures (default: the current folder)"
        )
        parser.add_argument("--videos", type=int, help="how many rows of the sheet (8), or of each look (1)")
        parser.add_argument("--gallery", action="store_true", help="instead, the same videos in every look, annotated")
        parser.add_argument("--seed", type=int, default=None, help="of a config")
        parser.add_argument(
            "--set",
            action="append",
            default=[],
            dest="overrides",
            metavar="A.B=V",
            help="override an option of a config",
        )
    return parser


def _add_network(parser: Parser) -> None:
    parser.add_argument(
        "--timeout", type=float, default=30.0, metavar="S", help="of a URL: seconds to wait for a server at a time (30)"
    )
    parser.add_argument(
        "--deadline", type=float, default=300.0, metavar="S", help="of a URL: seconds for a request in all (300)"
    )


def _add_export(parser: Parser) -> None:
    from gen2d.config.plugins import names

    parser.add_argument(
        "--to", required=True, metavar="FORMAT", help=f"one of {', '.join(names('export'))}, or a Python file"
    )
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help="what to make (default: DIR-FORMAT, beside the dataset)"
    )
    parser.add_argument("--split", metavar="NAME", help="which videos (default: the only split, or train)")
    parser.add_argument(
        "--fields",
        nargs="+",
        metavar="NAME",
        help="names or patterns such as 'states/*', where the format can hold any (default: all)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an export of another dataset")


def _worker(text: str) -> tuple[int, int]:
    number, slash, count = text.partition("/")
    if not slash or not all(part.isascii() and part.isdecimal() for part in (number, count)):
        raise UserError(f"--worker is {text!r}, but must be R/W, such as 0/4")
    return int(number), int(count)


def generate(arguments: Sequence[str]) -> int:
    """The main job; 0, or 130 when it was interrupted."""
    options = generating().parse_args(arguments)
    from gen2d.generation import run as job  # imports jax: only now

    try:
        summary = job.generate(
            options.config,
            options.n,
            options.out,
            seed=options.seed,
            split=options.split,
            overrides=options.overrides,
            device=options.device,
            worker=_worker(options.worker),
            overwrite=options.overwrite,
            say=_tell,
            timeout=options.timeout,
            deadline=options.deadline,
        )
    except KeyboardInterrupt:
        again = [a for a in arguments if a != "--overwrite"]
        print(f"gen2d: stopped; whole shards are kept. To go on: {job.command(again)}", file=sys.stderr, flush=True)
        os._exit(130)  # everything is closed; jax may still run in the background, and would crash at a normal end
    print(_summary_text(summary))
    return 0


def _summary_text(summary: Any) -> str:
    from gen2d.core.humanize import in_bytes, in_time

    if not summary.made:
        ready = "is complete" if summary.complete else "has all of this worker's shards"
        return f"{summary.out} {ready}: nothing to do."
    speed = f"{in_time(summary.seconds)} ({summary.videos_per_second:,.0f} videos/s)"
    text = f"{summary.made:,} videos in {speed}, {in_bytes(summary.bytes)}, in {summary.out}"
    return text if summary.complete else text + "; other workers' shards are still missing"


def verify(arguments: Sequence[str]) -> int:
    """0 if the dataset is whole, else 1 and what is wrong."""
    options = _verb_parser("verify").parse_args(arguments)
    from gen2d.tools.verify import verify_and_repair

    root = _root(options)
    with reading(root):
        begun = (root / ".gen2d" / "dataset.json").exists() or (isinstance(root, Path) and (root / ".gen2d").is_dir())
        if not begun and not (root / "manifest.json").exists():
            raise UserError(f"{root} is not a dataset that gen2d made")
    seed = secrets.randbelow(2**32) if options.seed is None else options.seed
    repair = _repairing(root, options) if options.repair else None
    limits = {"timeout": options.timeout, "deadline": options.deadline}
    outcome = verify_and_repair(root, options.level, repair, options.videos, seed, trust=options.trust, **limits)
    if options.json:
        about = {"dataset": f"{root}", "level": options.level, **dataclasses.asdict(outcome)}
        print(json.dumps(about | ({"videos": options.videos, "seed": seed} if options.level == "regen" else {})))
        return 1 if outcome.problems else 0
    for sentence in (*(f"repaired: {what}" for what in outcome.repaired), *outcome.problems):
        print(sentence)
    chosen = f", {options.videos} videos chosen by --seed {seed}" if options.level == "regen" else ""
    print(f"{root}: {'damaged' if outcome.problems else 'whole'} ({options.level} check{chosen})")
    return 1 if outcome.problems else 0


def _root(options: argparse.Namespace) -> Place:
    """The dataset that a verb is about."""
    return place(options.dataset, Network(options.timeout, options.deadline))


def _repairing(root: Place, options: argparse.Namespace) -> Callable[[list[str]], list[str]]:
    """What makes the shards with these names again."""

    def repair(names: list[str]) -> list[str]:
        from gen2d.generation import regenerate  # imports jax: only now

        limits = {"timeout": options.timeout, "deadline": options.deadline}
        return regenerate.repair(root, names, _tell, trust=options.trust, **limits)

    return repair


def info(arguments: Sequence[str]) -> int:
    """0, and a data sheet."""
    options = _verb_parser("info").parse_args(arguments)
    from gen2d.cli import report

    print(report.info(options.dataset, timeout=options.timeout, deadline=options.deadline))
    return 0


def clean(arguments: Sequence[str]) -> int:
    """0, and what was removed."""
    options = _verb_parser("clean").parse_args(arguments)
    from gen2d.dataset.folder import clean as remove

    root = _root(options)
    removed = remove(root)
    print("\n".join([*(one_line(f"removed: {name}") for name in removed), f"{root}: nothing else is left over"]))
    return 0


def listing(arguments: Sequence[str]) -> int:
    """0, and every plug-in and option."""
    options = _verb_parser("list").parse_args(arguments)
    from gen2d.cli.report import plugins_text

    print(plugins_text(options.name))
    return 0


def preview(arguments: Sequence[str]) -> int:
    """0, and the names of the pictures made."""
    options = _verb_parser("preview").parse_args(arguments)
    changes = {"seed": options.seed, "overrides": options.overrides, "trust": options.trust}
    changes |= {"timeout": options.timeout, "deadline": options.deadline}
    changes |= {} if options.videos is None else {"videos": options.videos}
    if options.gallery:
        from gen2d.tools.gallery import families, gallery

        out, every = options.out or Path(), options.dataset == "all"
        made = families(out, **changes) if every else [gallery(options.dataset, out, **changes)]
    else:
        from gen2d.tools.preview import preview as draw

        made = draw(options.dataset, options.out or Path(), **changes)
    print("\n".join(map(str, made)))
    return 0


def export(arguments: Sequence[str]) -> int:
    """0, and what was made."""
    options = _verb_parser("export").parse_args(arguments)
    from gen2d.core.humanize import in_bytes, in_time
    from gen2d.exports.export import export as write

    made = write(
        options.dataset,
        options.to,
        options.out,
        split=options.split,
        fields=options.fields,
        overwrite=options.overwrite,
        say=_tell,
        trust=options.trust,
        timeout=options.timeout,
        deadline=options.deadline,
    )
    loss = f"\n{options.to} is {made.loss}" if made.loss else ""
    print(f"{made.videos:,} videos in {in_time(made.seconds)}, {in_bytes(made.bytes)}, in {made.out}{loss}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code: 0, 1 for damaged data or a full disk, 2 for what the user can mend, 3 where a server or a disk
    does not answer, 130 when interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may not have every letter
            stream.reconfigure(errors="backslashreplace")
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    verbs = {"verify": verify, "info": info, "list": listing, "preview": preview, "export": export, "clean": clean}
    verb = verbs.get(arguments[0]) if arguments else None
    try:
        if verb:
            return verb(arguments[1:])
        if not arguments:
            generating().print_help()
            return 0
        if not arguments[0].startswith("-"):
            known = ", ".join(VERBS)
            fail(f"{arguments[0]!r} is not a verb; there are {known}, and without a verb --config and --n", 2)
        return generate(arguments)
    except Error as error:
        fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        fail("stopped", 130)
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        fail(str(reading_error(error.filename or "a file", error)), 1)
