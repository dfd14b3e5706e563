"""Dispatch of the command line's verbs, and exit codes."""

import io
import os
import sys
from collections.abc import Sequence

from gen2d.cli import clean, config, diff, export, generate, info, listing, plot, preview, push, verify, view
from gen2d.cli.output import output
from gen2d.cli.parser import parse
from gen2d.core.errors import Error, command_line
from gen2d.core.progress import logged_to_stderr
from gen2d.engines.protocol import HeadLostError
from gen2d.storage.explain import reading_error

VERBS = {
    "generate": generate,
    "preview": preview,
    "view": view,
    "plot": plot,
    "info": info,
    "verify": verify,
    "export": export,
    "push": push,
    "clean": clean,
    "diff": diff,
    "config": config,
    "list": listing,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of a command line, that of the process by default.

    0: success; 1: damaged data, a full disk, or a difference (`diff`); 2: an error that the user can correct; 3: a
    server or disk that does not answer; 130: interrupted.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # not every terminal encodes every character
    try:
        with command_line():
            options = parse(sys.argv[1:] if arguments is None else arguments, VERBS)
            with output(options), logged_to_stderr():
                code = options.run(options)
        sys.stdout.flush()
        return code
    except Error as error:
        sentence, code = str(error), error.exit_code
        if isinstance(error, HeadLostError):
            print(f"gen2d: {sentence}", file=sys.stderr, flush=True)
            os._exit(code)
    except KeyboardInterrupt:
        sentence, code = "stopped", 130
    except BrokenPipeError:  # the reader of the output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        sentence, code = str(reading_error(error.filename or "a file", error)), 1
    print(f"gen2d: {sentence}", file=sys.stderr)
    return code
