"""Errors that end a command: one sentence each, and an exit code."""

LONGEST = 800  # characters of a sentence; longer ones lose their middle


def one_line(text: str) -> str:
    """The text on one line of at most about `LONGEST` printable characters; others are escaped."""
    text = "".join(c if c.isprintable() else _escaped(c) for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def _escaped(character: str) -> str:
    return " " if character in "\n\r\t" else character.encode("unicode_escape").decode()


class Error(Exception):
    """An error with one sentence for the user, and the exit code of the command that it ends."""

    exit_code = 1

    def __init__(self, sentence: object) -> None:
        super().__init__(one_line(str(sentence)))


class UserError(Error):
    """An error that the user can correct; exit code 2."""

    exit_code = 2


class ConfigError(UserError):
    """An option that is not allowed; the sentence names file, field, value and what is allowed."""


class FolderError(UserError):
    """A dataset folder that cannot be used as asked."""


class IncompleteError(FolderError):
    """A folder without a complete dataset: none was begun there, or it is unfinished."""


class UntrustedError(UserError):
    """Code that came with a dataset and would have to run, but that the user does not trust."""


class DamagedError(Error):
    """Stored data that differs from what was written; the sentence names the file and the damage; exit code 1."""


class UnreachableError(Error):
    """A server or disk that does not answer, which says nothing about the data; exit code 3."""

    exit_code = 3
