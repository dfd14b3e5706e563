"""Make a dataset, or add videos to one (the verb if none is named)."""

import argparse
import dataclasses
import os
import shlex
from typing import TYPE_CHECKING, Any

from gen2d.cli.parser import (
    PROG,
    Parser,
    add_engine,
    add_images,
    add_network,
    add_overrides,
    engine_of,
    limits,
    whole_number,
)
from gen2d.core.errors import UserError
from gen2d.core.humanize import in_bytes, in_time

if TYPE_CHECKING:
    from gen2d.generation.run import Summary


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    meaning = "a config file, or the name of one that comes with gen2d"
    parser.add_argument("config", nargs="?", default=argparse.SUPPRESS, action=_OneConfig, metavar="YAML", help=meaning)
    parser.add_argument("--config", action=_OneConfig, metavar="YAML", help="the same, by a flag")
    parser.add_argument(
        "--n",
        required=True,
        type=whole_number,
        metavar="N",
        help="how many videos a split is to hold, those already there included",
    )
    parser.add_argument(
        "--out", metavar="DIR", help="the dataset's folder or URL (default: datasets/NAME in the current folder)"
    )
    parser.add_argument(
        "--seed", type=whole_number, metavar="S", help="a number from 0 to 2**63 - 1 (default: the config's seed, or 0)"
    )
    parser.add_argument(
        "--split", metavar="NAME", help="make this split only (default: all splits of the config, or train)"
    )
    add_overrides(parser)
    parser.add_argument(
        "--device",
        default="auto",
        choices=("auto", "cpu", "gpu"),
        help="where to compute (default: auto, a GPU if there is one)",
    )
    parser.add_argument(
        "--worker",
        default="0/1",
        type=_worker,
        metavar="R/W",
        help="share the work: worker R of W, counted from 0, makes every W-th shard (default: 0/1)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset of another config or seed")
    parser.add_argument(
        "--json", action="store_true", help="print progress, lost workers and the result as JSON, an object per line"
    )
    add_engine(parser)
    add_images(parser)
    add_network(parser)


class _OneConfig(argparse.Action):
    """Store the config, which is given by its place or by its flag."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        if option_string is None and getattr(namespace, "config", None) is not None:
            parser.error(f"{values!r} is one argument too many")
        namespace.config = values


def _worker(text: str) -> tuple[int, int]:
    number, slash, count = text.partition("/")
    if not slash or not all(part.isascii() and part.isdecimal() for part in (number, count)):
        raise UserError(f"--worker is {text!r}, but must be R/W, such as 0/4")
    return int(number), int(count)


def run(options: argparse.Namespace) -> int:
    """Generate the dataset, or this worker's share of it; the exit code of the verb."""
    from gen2d.core.progress import Event, to_json, to_stderr, waiting

    if options.config is None:
        raise UserError(f"a config is needed, such as bouncing.yaml; `{PROG} list` names those that come with gen2d")
    log, engine = to_json if options.json else to_stderr, engine_of(options)
    with waiting("Importing jax", log):
        from gen2d.generation.run import generate
        from gen2d.storage.filesystems import redact_url

    try:
        summary = generate(
            options.config,
            options.n,
            options.out,
            seed=options.seed,
            split=options.split,
            overrides=options.overrides,
            device=options.device,
            worker=options.worker,
            engine=engine,
            overwrite=options.overwrite,
            log=log,
            **limits(options),
        )
    except KeyboardInterrupt:
        again = [shlex.quote(redact_url(word)) for word in options.arguments if word != "--overwrite"]
        to_stderr(f"gen2d: stopped; complete shards are kept. To go on: {' '.join([PROG, *again])}")
        os._exit(130)  # all files are closed; jax may still compute in the background, and would crash a normal exit
    if options.json:
        log(Event.of(_report(summary), "end", **dataclasses.asdict(summary) | {"out": str(summary.out)}))
    else:
        print(_report(summary))
    return 0


def _report(summary: "Summary") -> str:
    if not summary.generated:
        ready = "is complete" if summary.complete else "has all of this worker's shards"
        return f"{summary.out} {ready}: nothing to do."
    speed = f"{in_time(summary.seconds)} ({summary.videos_per_second:,.0f} videos/s after compiling)"
    text = f"{summary.generated:,} videos in {speed}, {in_bytes(summary.bytes)}, in {summary.out}"
    return text if summary.complete else text + "; other workers' shards are still missing"
