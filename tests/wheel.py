"""Checks an installed wheel: its top level, and that looks and configs came along. `versions.sh` runs it elsewhere."""

import importlib
import sys
import zipfile

import gen2d
from gen2d.config import plugins

names = zipfile.ZipFile(sys.argv[1]).namelist()
assert len(names) == len(set(names)), "a file is in the wheel twice"
top = {name.split("/")[0] for name in names}
assert top == {"gen2d", f"gen2d-{gen2d.__version__}.dist-info"}, top
assert not [name for name in names if name.startswith(("gen2d/datasets", "gen2d/tests", "gen2d/gen2d"))]
assert "site-packages" in gen2d.__file__, gen2d.__file__
assert "flat" in plugins.names("look")
assert "bouncing.yaml" in plugins.config_names()
for name in ("renderers", "configs"):
    importlib.import_module(f"gen2d.{name}")
for name in ("datasets", "tests", "gen2d"):
    try:
        importlib.import_module(f"gen2d.{name}")
    except ModuleNotFoundError:
        continue
    raise AssertionError(f"gen2d.{name} can be imported")
print("the wheel holds what it should")
