"""Completion scripts of shells, by the optional package shtab."""

import argparse
from collections.abc import Sequence

from gen2d.core.errors import UserError

SHELLS = "bash", "zsh", "tcsh"
COMMAND = "gen2d"  # shells complete the words after a command; they cannot complete those after `python -m gen2d`


def completion_script(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    """The completion script asked for by `--print-completion SHELL`. Raises UserError without shtab or a known shell.

    `parser` has the arguments of all verbs.
    """
    shell = " ".join(words).removeprefix("--print-completion").lstrip(" =")
    if shell not in SHELLS:
        raise UserError(f"--print-completion is {shell!r}, but must be one of {', '.join(SHELLS)}")
    try:
        import shtab
    except ImportError:
        raise UserError("completion needs shtab: pip install 'gen2d[completion]'") from None
    parser.prog = COMMAND
    return shtab.complete(parser, shell)
