"""Formats of other programs: one file per format, found by its name.

Each has `LOSS`, what is not kept ("" where all of it is), `FIELDS`, the patterns of the fields that it holds, `FIXED`,
whether it can hold no others, `SUFFIX`, the ending of the one file that it makes ("" where it fills a folder), and

    check(source)           raises ConfigError where this dataset cannot be held
    write(target, source)   fills the folder, or the file
"""

import pkgutil


def names() -> list[str]:
    """The names of the formats."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))
