"""Argument parsers of the command line: verbs, arguments that they share, and one sentence for each error."""

import argparse
import difflib
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from gen2d._version import __version__
from gen2d.config.plugins import config_names, nearest
from gen2d.core.errors import UserError
from gen2d.storage.image_folder import use_images

if TYPE_CHECKING:
    from gen2d.engines.ray import Ray

T = TypeVar("T")
PROG = "python -m gen2d"
USAGE = """\
python -m gen2d YAML --n N [options]
       python -m gen2d VERB [options]"""
DESCRIPTION = "Make datasets of rendered videos of 2D rigid bodies, with every ground truth."
EXAMPLES = """\
examples:
  draw a config before making a dataset:
    python -m gen2d preview bouncing.yaml
  make 1000 videos in datasets/bouncing, then 4000 more:
    python -m gen2d bouncing.yaml --n 1000
    python -m gen2d bouncing.yaml --n 5000
  make videos of another size, with another seed, in another folder:
    python -m gen2d bouncing.yaml --n 100 --set video.height=128 \\
      --set video.width=128 --seed 7 --out /data/larger
"""


class Parser(argparse.ArgumentParser):
    """A verb's parser. Option names cannot be shortened; each error is a UserError of one sentence."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        message = message.removeprefix("argument ")
        if found := re.fullmatch(r"(\S+): invalid choice: (.*) \(choose from (.*)\)", message):
            name, value, allowed = found.groups()
            allowed = allowed.replace("'", "")
            raise UserError(f"{name} is {value}, but must be one of {allowed}")
        raise UserError(f"{message}; see {self.prog} --help")

    def check_names(self, words: Sequence[str]) -> None:
        """Raises UserError for an unknown option; argparse would first complain of one that is missing."""
        known = [name for name in self._option_string_actions if name.startswith("--")]
        for word in itertools.takewhile(lambda word: word != "--", words):
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known:
                likely = [option for option in known if option.startswith(name)] or known
                close = difflib.get_close_matches(name[2:], [option[2:] for option in likely], n=1)
                hint = f"did you mean --{close[0]}?" if close else f"there are: {', '.join(sorted(known))}"
                raise UserError(f"{name} is not an option; {hint}")


def parse(arguments: Sequence[str], verbs: Mapping[str, ModuleType]) -> argparse.Namespace:
    """Options of a command line, with the function that runs its verb as `run`.

    A verb is a module with `add_arguments(parser)` and `run(options)`, described by its docstring. `generate` is the
    verb of a line that starts with an option or a config. Raises UserError; exits after --help and --version.
    """
    top = argparse.ArgumentParser(
        prog=PROG,
        usage=USAGE,
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"gen2d {__version__}")
    parsers = top.add_subparsers(
        title="verbs", metavar="VERB", prog=PROG, parser_class=Parser, help=f"see {PROG} VERB --help for its options"
    )
    parser_of = {
        verb: parsers.add_parser(verb, help=module.__doc__, description=module.__doc__)
        for verb, module in verbs.items()
    }
    top.add_argument(
        "--print-completion", metavar="SHELL", help="print the completion script of a shell: bash, zsh or tcsh"
    )
    words = list(arguments) or ["--help"]
    if words[0].partition("=")[0] == "--print-completion":
        from gen2d.cli.completion import completion_script

        for name, module in verbs.items():
            module.add_arguments(parser_of[name])
            add_output(parser_of[name])
        print(completion_script(top, words))
        raise SystemExit(0)
    if words[0] in ("--help", "-h", "--version"):
        top.parse_args(words)  # exits
    is_config = words[0].endswith((".yaml", ".yml")) or f"{words[0]}.yaml" in config_names()
    verb, *words = ["generate", *words] if words[0].startswith("-") or is_config else words
    if verb not in verbs:
        raise UserError(f"{verb!r} is not a verb; {nearest(verb, [*verbs])}")
    parser = parser_of[verb]
    verbs[verb].add_arguments(parser)
    add_output(parser)
    parser.check_names(words)
    # Options may stand between positional arguments, but intermixed parsing loses a '--'.
    read = parser.parse_known_args if "--" in words else parser.parse_known_intermixed_args
    options, extra = read(words, argparse.Namespace(arguments=arguments, run=verbs[verb].run))
    if extra:
        parser.error(f"{extra[0]!r} is one argument too many")
    return options


def add_dataset(parser: Parser) -> None:
    """Adds the dataset that a verb is about."""
    parser.add_argument("dataset", metavar="DIR", help="the dataset's folder or URL")


def add_network(parser: Parser) -> None:
    """Adds how long to wait for a server."""
    parser.add_argument(
        "--timeout",
        type=_seconds,
        default=30.0,
        metavar="S",
        help="for a URL: seconds to wait for a server that sends nothing (default: 30)",
    )
    parser.add_argument(
        "--deadline",
        type=_seconds,
        default=300.0,
        metavar="S",
        help="for a URL: seconds that a request and its retries may take together (default: 300)",
    )


def limits(options: argparse.Namespace) -> dict[str, float]:
    """The arguments that `add_network` added, as keywords."""
    return {"timeout": options.timeout, "deadline": options.deadline}


def add_output(parser: Parser) -> None:
    """Adds how much a verb prints, and where else."""
    group = parser.add_argument_group("output")
    amount = group.add_mutually_exclusive_group()
    amount.add_argument("-q", "--quiet", action="store_true", help="print the result and errors only")
    amount.add_argument(
        "-v", "--verbose", action="store_true", help="print the time before each message, and where an error was raised"
    )
    group.add_argument("--log", metavar="FILE", help="append all that is printed to this file, with dates and times")


def add_overrides(parser: Parser) -> None:
    """Adds changes of single options of a config."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=V",
        dest="overrides",
        help="set one option of the config, such as physics.substeps=8 (may be repeated)",
    )


def add_trust(parser: Parser) -> None:
    """Adds which code of a dataset may run."""
    parser.add_argument(
        "--trust",
        action="append",
        default=[],
        metavar="SHA256",
        help="allow the Python file with this hash, which came with the dataset, to run (may be repeated)",
    )


def add_images(parser: Parser) -> None:
    """Adds a folder of images for backgrounds."""
    parser.add_argument(
        "--images",
        type=use_images,
        metavar="DIR",
        help="a folder of images for look.background_kind: images; a dataset holds their hashes alone, so name it "
        "again to render its frames again",
    )


ENGINE_OPTIONS = ("address", "workers", "gpus_per_worker", "cpus_per_worker", "device_kind", "retries")


def add_engine(parser: Parser) -> None:
    """Adds where the work runs."""
    group = parser.add_argument_group("clusters", "see docs/engines.md")
    group.add_argument(
        "--engine",
        default="local",
        choices=("local", "ray"),
        help="where to run: local, in this process, or ray, on a Ray cluster (default: local)",
    )
    group.add_argument(
        "--address",
        metavar="A",
        help="the cluster: auto, HOST:PORT or ray://HOST:PORT (default: $RAY_ADDRESS, or this machine alone)",
    )
    group.add_argument(
        "--workers",
        type=argument(_worker_limits, "MIN:MAX, such as 1:8"),
        metavar="MIN:MAX",
        help="the least and the largest number of workers (default: 1 and as many as the cluster holds)",
    )
    group.add_argument(
        "--gpus-per-worker",
        type=argument(float, "a number, such as 1"),
        metavar="N",
        help="GPUs of a worker (default: 1)",
    )
    group.add_argument(
        "--cpus-per-worker",
        type=whole_number,
        metavar="N",
        help="cores of a worker (default: all of its machine, or an equal share)",
    )
    group.add_argument(
        "--device-kind", metavar="K", help="use only devices with this in their names, such as H100 or avx512f"
    )
    group.add_argument(
        "--retries", type=whole_number, metavar="N", help="how often a shard that fails is tried again (default: 3)"
    )


def engine_of(options: argparse.Namespace) -> "Ray | None":
    """The engine that the arguments of `add_engine` name; None for this process."""
    given = {name: value for name in ENGINE_OPTIONS if (value := getattr(options, name)) is not None}
    if options.engine == "local":
        if given:
            raise UserError(f"--{next(iter(given)).replace('_', '-')} needs --engine ray")
        return None
    from gen2d.engines.ray import Ray

    return Ray(**given)


def argument(parse: Callable[[str], T], what: str) -> Callable[[str], T]:
    """Parser of an argument's text, whose ValueError becomes the sentence that the text is not `what`."""

    def parsed(text: str) -> T:
        try:
            return parse(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}") from None

    return parsed


def _worker_limits(text: str) -> tuple[int, int | None]:
    low, colon, high = text.partition(":")
    return int(low or 1), (int(high) if high else None) if colon else int(low)


def _whole_number(text: str) -> int:
    """A whole number such as 100, 10_000 or 1e5."""
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if not number.is_integer() or abs(number) >= 2**53:  # beyond, a float is not exact
            raise
        return int(number)


whole_number = argument(_whole_number, "a whole number, such as 100")
_seconds = argument(float, "a number of seconds, such as 30")
