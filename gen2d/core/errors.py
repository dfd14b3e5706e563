"""Errors for a person: one sentence each, and the exit code that the command line ends with."""

LONGEST = 800  # characters of a sentence; what is quoted in it may be longer


def one_line(text: str) -> str:
    """The text on one line that a terminal shows as it is, however it was put together."""
    text = "".join(c if c.isprintable() else _escaped(c) for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def _escaped(character: str) -> str:
    return " " if character in "\n\r\t" else character.encode("unicode_escape").decode()


class Error(Exception):
    """What ends a command: one sentence, and an exit code."""

    exit_code = 1

    def __init__(self, sentence: object) -> None:
        super().__init__(one_line(str(sentence)))


class UserError(Error):
    """Something that the user can mend; exit code 2."""

    exit_code = 2


class ConfigError(UserError):
    """An option that cannot be: the sentence names file, field, value and what is allowed."""


class FolderError(UserError):
    """A dataset folder that cannot be used as asked."""


class IncompleteError(FolderError):
    """A folder without a whole dataset: none was begun there, or it is not finished."""


class UntrustedError(UserError):
    """Code of a dataset's that would have to run, and that this user has not said to trust."""


class DamagedError(Error):
    """Stored data that is not what was written; the sentence names the file and what is wrong with it; exit code 1."""


class UnreachableError(Error):
    """A server or disk that gave no answer, so that nothing is known of the data; exit code 3."""

    exit_code = 3
