"""The fsspec file systems behind URLs, and texts about URLs without their secrets."""

import functools
import os
from typing import Any

from gen2d.core.errors import FolderError

_COMMON = ("s3", "gs", "az", "http", "https", "sftp", "memory", "file")


def redact_url(text: str) -> str:
    """A URL without its secrets: user name, password and query."""
    start, separator, remainder = text.partition("://")
    if not separator:
        return text
    remainder, question, _ = remainder.partition("?")
    host, slash, path = remainder.partition("/")
    _, at_sign, host_only = host.rpartition("@")
    return f"{start}://{'***@' if at_sign else ''}{host_only}{slash}{path}{'?***' if question else ''}"


def redact(sentence: str, url: str, query: str = "") -> str:
    """A library's message about a URL, without the URL's secrets."""
    host = url.partition("://")[2].partition("/")[0]
    user = host.rpartition("@")[0]
    values = [pair.partition("=")[2] for pair in query.lstrip("?").split("&")]
    for secret in (query, user, *user.split(":"), *values):
        if len(secret) > 2:
            sentence = sentence.replace(secret, "***")
    return sentence


def file_system(url: str, timeout: float) -> Any:
    """The fsspec file system of a URL in this process; `timeout` is in seconds. Raises FolderError."""
    return _connect("/".join(url.split("/")[:3]), timeout, os.getpid())  # a forked process needs its own


@functools.lru_cache(maxsize=32)
def _connect(start: str, timeout: float, process: int) -> Any:
    name = redact_url(start)
    try:
        import fsspec
    except ImportError:
        raise FolderError(f"{name} needs fsspec: pip install 'gen2d[remote]'") from None
    try:
        # No cached listings: files of other processes must be seen at once.
        return fsspec.core.url_to_fs(start, use_listings_cache=False, **_limits(start, timeout))[0]
    except ImportError as error:
        hint = ": pip install 'gen2d[remote]'" if start.startswith(("s3:", "http")) else ""
        raise FolderError(f"{name} needs another package ({error}){hint}") from None
    except Exception as error:
        known = ", ".join(sorted(name for name in fsspec.available_protocols() if name in _COMMON))
        reason = redact(" ".join(str(error).split()), start)
        raise FolderError(f"{name} cannot be used ({reason}); common protocols are {known}") from None


def _limits(start: str, timeout: float) -> dict[str, Any]:
    """The options that limit a file system's waiting; other protocols keep their own limits."""
    if start.startswith(("http://", "https://")):
        import aiohttp

        limits = aiohttp.ClientTimeout(total=None, sock_connect=timeout, sock_read=timeout)
        return {"client_kwargs": {"timeout": limits}}
    if start.startswith(("s3://", "s3a://")):
        retries = {"max_attempts": 1}  # `retries.attempt` tries again
        return {"config_kwargs": {"connect_timeout": timeout, "read_timeout": timeout, "retries": retries}}
    return {}
