"""More devices give what one gives."""

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent


def test_eight_devices_give_what_one_gives():
    flags = "--xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, str(TESTS / "distributed.py")],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
