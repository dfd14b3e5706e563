"""Processes that are killed at a chosen change of the disk: the first, the second, and so on."""

import os
import signal
import traceback
from collections.abc import Callable, Iterator
from typing import Any

# Calls that change names or contents on the disk, or flush them.
CHANGES = ("replace", "rename", "unlink", "mkdir", "rmdir", "fsync", "ftruncate", "write", "link", "symlink")


def _kill_at_call(call: Callable[..., Any], left: list[int], after: bool) -> Callable[..., Any]:
    def counted(*arguments: Any, **named: Any) -> Any:
        left[0] -= 1
        if left[0] == 0 and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            return call(*arguments, **named)
        finally:
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    return counted


def died_at(change: int, work: Callable[[], Any], after: bool = False) -> bool:
    """Whether a fork that runs `work` reaches this change (counted from 1), right before or after which it dies."""
    pid = os.fork()
    if not pid:
        remaining = [change]
        for name in CHANGES:
            setattr(os, name, _kill_at_call(getattr(os, name), remaining, after))
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert code in (0, -signal.SIGKILL), code
    return code != 0


def every_crash(work: Callable[[], Any], step: int = 1) -> Iterator[int]:
    """Yield after each crash of a process that runs `work` and is killed `step` changes later each time.

    The caller restores the initial state. The iteration ends when `work` completes.
    """
    change, after = 1, False
    while died_at(change, work, after):
        yield change
        change, after = change + step, not after
