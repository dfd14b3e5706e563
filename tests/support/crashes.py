"""A process that dies in the middle of what it does to the disk: at the first change, at the second, at every one."""

import os
import signal
import traceback
from collections.abc import Callable, Iterator
from typing import Any

# Whatever changes names or says that something is on the disk.
CHANGES = ("replace", "rename", "unlink", "mkdir", "rmdir", "fsync", "ftruncate", "write", "link", "symlink")


def _dying(call: Callable[..., Any], left: list[int], after: bool) -> Callable[..., Any]:
    def changed(*arguments: Any, **named: Any) -> Any:
        left[0] -= 1
        if left[0] == 0 and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            return call(*arguments, **named)
        finally:
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    return changed


def died_at(change: int, work: Callable[[], Any], after: bool = False) -> bool:
    """Whether a forked process that does the work dies at its change with this number, right before or after it."""
    process = os.fork()
    if not process:
        left = [change]
        for name in CHANGES:
            setattr(os, name, _dying(getattr(os, name), left, after))
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code in (0, -signal.SIGKILL), code
    return code != 0


def every_crash(work: Callable[[], Any], step: int = 1) -> Iterator[int]:
    """Does the work again and again in processes that die one change later each time; yields after each death. The
    caller restores what was there. Ends when the work does."""
    change, after = 1, False
    while died_at(change, work, after):
        yield change
        change, after = change + step, not after
