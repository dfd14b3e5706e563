"""Check a dataset against its checksums or its recipe, and repair it."""

import argparse
import dataclasses
import json
import secrets

from gen2d.cli.parser import (
    Parser,
    add_dataset,
    add_engine,
    add_images,
    add_network,
    add_trust,
    engine_of,
    limits,
    whole_number,
)
from gen2d.core.errors import UserError


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    add_dataset(parser)
    parser.add_argument(
        "--level",
        choices=("quick", "full", "regen"),
        default="full",
        help="quick: names and sizes of files, and the index; full: every byte; regen: every byte, and some videos are "
        "made again and compared (default: full)",
    )
    parser.add_argument(
        "--videos", type=whole_number, default=8, metavar="K", help="how many videos regen makes again (default: 8)"
    )
    parser.add_argument(
        "--seed",
        type=whole_number,
        metavar="S",
        help="the seed that chooses these videos (default: another one each time, which is printed)",
    )
    parser.add_argument("--repair", action="store_true", help="make damaged files again, from the dataset's recipe")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    add_trust(parser)
    add_engine(parser)
    add_images(parser)
    add_network(parser)


def run(options: argparse.Namespace) -> int:
    """Check, and repair if asked to; the exit code of the verb."""
    from gen2d.dataset.manifest import is_begun
    from gen2d.dataset.spec import MANIFEST
    from gen2d.storage.paths import place, reading
    from gen2d.storage.retries import Network
    from gen2d.tools.verify import verify_and_repair

    engine = engine_of(options)
    root = place(options.dataset, Network(**limits(options)))
    with reading(root):
        if not is_begun(root) and not (root / MANIFEST).exists():
            raise UserError(f"{root} is not a dataset that gen2d made")

    def repair(shards: list[str]) -> list[str]:
        from gen2d.core.progress import to_stderr, waiting

        with waiting("Importing jax"):
            from gen2d.generation import regenerate

        return regenerate.repair(root, shards, to_stderr, trust=options.trust, engine=engine, **limits(options))

    seed = secrets.randbelow(2**32) if options.seed is None else options.seed
    repair_with = repair if options.repair else None
    outcome = verify_and_repair(root, options.level, repair_with, options.videos, seed, options.trust, engine)
    if options.json:
        result = {"dataset": f"{root}", "level": options.level, **dataclasses.asdict(outcome)}
        print(json.dumps(result | ({"videos": options.videos, "seed": seed} if options.level == "regen" else {})))
    else:
        for sentence in (*(f"repaired: {problem}" for problem in outcome.repaired), *outcome.problems):
            print(sentence)
        chosen = f", {options.videos} videos chosen by --seed {seed}" if options.level == "regen" else ""
        print(f"{root}: {'damaged' if outcome.problems else 'whole'} ({options.level} check{chosen})")
    return 1 if outcome.problems else 0
