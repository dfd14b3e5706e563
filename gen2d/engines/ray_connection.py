"""Connection of the driver to a Ray cluster, without Ray's own output."""

import atexit
import contextlib
import importlib
import logging
import os
import re
import socket
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gen2d.core.errors import argument, one_line
from gen2d.core.progress import Log, waiting
from gen2d.engines.protocol import EngineError, HeadLostError
from gen2d.storage.atomic import remove_tree
from gen2d.storage.leases import LOCK, lease, remove_abandoned, temporary_files, temporary_name

LONGEST_FOLDER = 45  # characters; the path of a socket has 107 at most
HEADLESS = 20.0  # s without a head before the run ends
CONNECTING = 10.0  # s


class Connection:
    """Ray, connected to a cluster, without its own output."""

    def __init__(self, address: str | None, log: Log) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            with waiting("Importing Ray", log):
                import ray
        except ImportError:
            raise EngineError("Ray is not installed: pip install 'gen2d[ray]', or '.[ray]' in a checkout") from None
        self.ray, self.dashboard, self.is_own = ray, "", False
        self.leases = contextlib.ExitStack()  # on the folder
        self.head: str | None = None  # its address, if it can be reached from here
        self.answered, self.is_lost = time.monotonic(), False
        self.was_connected = ray.is_initialized()
        if self.was_connected:
            return
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        self.is_own = address == "local"
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
        if self.is_own:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
            options |= {"num_cpus": cores, "include_dashboard": False, "object_store_memory": 10**8}
            options |= {"_temp_dir": str(self._own_folder())}
        else:
            _check_reachable(address)
        try:
            with waiting("Starting Ray" if self.is_own else f"Connecting to {address}", log), _quiet():
                context = ray.init(address, **options)
        except Exception as error:
            self._remove_folder()
            raise EngineError(
                f"{argument('address')} is {address}, but Ray cannot be used there ({_reason(error)})"
            ) from None
        with contextlib.suppress(ImportError):  # it would print every death again, on standard output
            worker: Any = importlib.import_module("ray._private.worker")
            worker.print_to_stdstream = lambda *_, **__: None
        dashboard = getattr(context, "dashboard_url", "")
        self.dashboard = f"; dashboard at http://{dashboard}" if dashboard and not self.is_own else ""

        with contextlib.suppress(Exception):  # unknown where a proxy stands between, at ray://
            self.head = None if "://" in address else ray.get_runtime_context().gcs_address

    def has_head(self) -> bool:
        """Whether the head of the cluster answers. Raises EngineError if it has not for a while.

        Ray's own calls would wait for it, and end this process.
        """
        if self.head is None:
            return True
        host, _, port = self.head.rpartition(":")
        try:
            socket.create_connection((host, int(port)), 1.0).close()
        except OSError:
            if time.monotonic() > self.answered + HEADLESS:
                self.is_lost = True
                raise HeadLostError(f"the head of the cluster, {self.head}, is lost; what is made stays") from None
            return False
        self.answered = time.monotonic()
        return True

    def abandon(self) -> None:
        """Leave a cluster without a head; its workers end by themselves."""
        with contextlib.suppress(ImportError):
            atexit.unregister(importlib.import_module("ray._private.worker").shutdown)
        self._remove_folder()

    def close(self) -> None:
        if not self.was_connected:
            with _quiet():
                self.ray.shutdown()
            self._remove_folder()

    def _own_folder(self) -> Path:
        """Folder of the files of Ray on this machine alone; those that killed runs left are removed."""
        folder = Path(tempfile.gettempdir()) / temporary_name("gen2d-ray")
        if len(str(folder)) > LONGEST_FOLDER:
            folder = Path("/tmp") / folder.name
        remove_abandoned(temporary_files(folder.parent, "gen2d-ray."))
        lock = folder.with_name(folder.name + LOCK)
        self.leases.enter_context(lease(lock))
        self.leases.callback(lock.unlink, missing_ok=True)
        self.leases.callback(remove_tree, folder)
        return folder

    def _remove_folder(self) -> None:
        self.leases.close()


def _check_reachable(address: str) -> None:
    """Raise EngineError if nothing answers at HOST:PORT or ray://HOST:PORT; Ray itself would try for minutes."""
    match = re.fullmatch(r"(?:ray://)?([^:/\s]+|\[[0-9a-fA-F:]+\]):(\d{1,5})", address)
    if address == "auto":
        return
    if not match:
        raise EngineError(f"{argument('address')} is {address!r}, but must be auto, HOST:PORT or ray://HOST:PORT")
    try:
        socket.create_connection((match[1].strip("[]"), int(match[2])), CONNECTING).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise EngineError(f"{argument('address')} is {address}, where nothing answers ({reason})") from None


def _reason(error: Exception) -> str:
    """The first sentence of an error of Ray."""
    text = one_line(str(error)).strip()
    if "Could not find any running Ray instance" in text:
        return "no cluster runs on this machine: ray start --head starts one"
    return re.split(r"(?<=[.!?]) ", text)[0].rstrip(".") or type(error).__name__


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Context in which Ray's C++ code prints nothing, and nobody warns of starting processes where jax runs."""
    with warnings.catch_warnings(), contextlib.ExitStack() as stack:
        warnings.simplefilter("ignore")
        ours = sys.stderr
        with contextlib.suppress(OSError, ValueError, AttributeError):  # it may be no file
            if ours.fileno() == 2:
                copy = os.dup(2)
                sys.stderr = stack.enter_context(os.fdopen(copy, "w", buffering=1))
                stack.callback(setattr, sys, "stderr", ours)
                stack.callback(os.dup2, copy, 2)
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, 2)
                os.close(null)
        yield
