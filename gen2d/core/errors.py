"""Errors for a person: one sentence each, and the exit code that the command line ends with."""


class UserError(Exception):
    """Something that the user can mend; exit code 2."""

    exit_code = 2


class ConfigError(UserError):
    """An option that cannot be: the sentence names file, field, value and what is allowed."""


class FolderError(UserError):
    """A dataset folder that cannot be used as asked."""


class UntrustedError(UserError):
    """Code of a dataset's that would have to run, and that this user has not said to trust."""


class DamagedError(Exception):
    """Stored data that is not what was written; the sentence names the file and what is wrong with it; exit code 1."""

    exit_code = 1


class UnreachableError(Exception):
    """A server or disk that gave no answer, so that nothing is known of the data; exit code 3."""

    exit_code = 3
