"""`lpac.api` in a process of its own: what is loaded when."""

import subprocess
import sys

LOOK = """
import sys
import lpac.api
print(*sorted({"numpy", "matplotlib", "onnxruntime", "mavsdk"} & set(sys.modules)))
lpac.api.fly
print(*sorted({"numpy", "matplotlib", "mavsdk"} & set(sys.modules)))
for package in ("torch", "onnx", "aiohttp", "textual", "ray"):
    sys.modules[package] = None
from lpac.api import *
"""


def test_what_is_used_is_loaded_then_and_torch_never() -> None:
    told = subprocess.run(
        [sys.executable, "-W", "error", "-c", LOOK], capture_output=True, text=True, check=False
    )
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.splitlines() == ["", "numpy"]
