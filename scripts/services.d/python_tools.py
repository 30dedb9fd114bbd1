"""The Python packages that tests use: in a folder of their own, so that they need no virtual environment."""

import os
import sys

from common import HOME, TEMPLATES, Failure

# Compiled packages fit one version of Python.
FOLDER = HOME / "python" / f"{sys.version_info.major}.{sys.version_info.minor}"
LOCK = TEMPLATES / "python.lock"


def environment() -> dict[str, str]:
    """For programs that use them, with `python3 -m`."""
    if not FOLDER.is_dir():
        raise Failure("the Python tools are missing: run scripts/services install")
    return {
        **os.environ,
        "PYTHONPATH": str(FOLDER),
        "PYTHONNOUSERSITE": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PATH": f"{FOLDER / 'bin'}:{os.environ.get('PATH', os.defpath)}",
    }
