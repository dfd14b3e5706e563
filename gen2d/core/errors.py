"""Errors that end a command: one sentence each, and an exit code."""

import contextlib
from collections.abc import Generator

LONGEST = 800  # characters of a message; longer messages lose their middle


def one_line(text: str) -> str:
    """The text on one line of about `LONGEST` characters at most, with unprintable characters escaped."""
    text = "".join(c if c.isprintable() else _escape(c) for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def _escape(character: str) -> str:
    return " " if character in "\n\r\t" else character.encode("unicode_escape").decode()


class Error(Exception):
    """Base class of gen2d's errors: one sentence for the user, and the exit code of the command."""

    exit_code = 1

    def __init__(self, sentence: object) -> None:
        super().__init__(one_line(str(sentence)))


class UserError(Error):
    """An error that the user can correct. Exit code 2."""

    exit_code = 2


class ConfigError(UserError):
    """An invalid option; the sentence names the file, the field, its value and the values allowed."""


class FolderError(UserError):
    """A dataset folder that cannot be used as requested."""


class IncompleteError(FolderError):
    """A folder that holds no dataset, or an unfinished one."""


class UntrustedError(UserError):
    """Untrusted code that came with a dataset and would have to run."""


class DamagedError(Error):
    """Stored data that has changed since it was written; the sentence names the file and the damage. Exit code 1."""


class UnreachableError(Error):
    """A server or disk that does not respond; the data itself may be intact. Exit code 3."""

    exit_code = 3


# ---- Names of arguments

# Names that differ from those of the flags.
_PYTHON = {"config": "config", "set": "overrides", "images": "gen2d.use_images"}
_command_lines = 0  # in progress


@contextlib.contextmanager
def command_line() -> Generator[None]:
    """Context of a command line, in which errors name flags."""
    global _command_lines
    _command_lines += 1
    try:
        yield
    finally:
        _command_lines -= 1


def argument(name: str, value: object = None) -> str:
    """An argument for a message as its user writes it: `--out` on a command line, `out` in Python.

    With a value it is `--device cpu`, or `device='cpu'`; with True `--overwrite`, or `overwrite=True`.
    """
    if _command_lines:
        flag = f"--{name.replace('_', '-')}"
        return flag if value is None or value is True else f"{flag} {value}"
    own = _PYTHON.get(name, name)
    return own if value is None else f"{own}={[value] if name == 'set' else value!r}"
