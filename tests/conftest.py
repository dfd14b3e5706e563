"""Every test shares one cache of compiled programs, also the processes that tests start."""

import os
import tempfile

_CACHE = tempfile.TemporaryDirectory(prefix="gen2d-test-cache-")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _CACHE.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
