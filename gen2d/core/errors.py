"""What the program says to a person when it cannot go on: one sentence, and an exit code."""


class UserError(Exception):
    """Something the user can mend; the command line prints the sentence and exits with code 2."""

    exit_code = 2


class ConfigError(UserError):
    """An option that cannot be: the sentence names file, field, value and what is allowed."""


class FolderError(UserError):
    """A dataset folder that cannot be used as asked."""


class DamagedError(Exception):
    """Stored data that is not what was written; the sentence names the file and what is wrong with it."""

    exit_code = 1
