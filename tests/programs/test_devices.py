"""Devices are chosen when the work begins: no import and no config starts jax before."""

import subprocess
import sys

import jax

from gen2d.programs import devices

STARTS_NOTHING = """
import importlib, pkgutil
import jax
import gen2d
from gen2d.config.config import load_config
from gen2d.config.plugins import config_names

LEFT_OUT = ("gen2d.__main__", "gen2d.torch")  # the command, and what needs another library
for module in pkgutil.walk_packages(gen2d.__path__, "gen2d."):
    if module.name not in LEFT_OUT:
        importlib.import_module(module.name)
for name in config_names():
    load_config(name)
jax.config.update("jax_num_cpu_devices", 3)  # raises RuntimeError once jax has devices
assert len(jax.devices("cpu")) == 3
"""


def test_no_module_and_no_config_starts_jax_before_the_devices_are_chosen():
    """Else jax has one CPU device, and a run uses one core; and `--device cpu` comes too late beside a GPU."""
    subprocess.run([sys.executable, "-c", STARTS_NOTHING], check=True)


def test_a_process_that_runs_jax_already_computes_on_all_cores(monkeypatch):
    first = jax.devices("cpu")[0]
    monkeypatch.setattr(devices, "cores", lambda: 5)
    assert devices.prepare("cpu") == [first] * 5
