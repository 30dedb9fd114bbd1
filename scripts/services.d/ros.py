"""The Python packages of two releases of ROS 2, and cyclonedds among those of the first: a virtual environment each, since
their start file looks for libraries there alone."""

import sys
from pathlib import Path

from common import HOME, TEMPLATES, Failure

RELEASES = ("jazzy", "kilted")


def lock(release: str) -> Path:
    return TEMPLATES / f"ros-{release}.lock"


def folder(release: str) -> Path:
    return HOME / "ros" / release


def packages(release: str) -> Path:
    """Where they lie; compiled ones fit one version of Python."""
    return folder(release) / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"


def python(release: str) -> Path:
    """The Python that has the packages of a release."""
    if not (packages(release) / "rclpy").is_dir():
        raise Failure(f"rclpy of {release} is missing: run scripts/services install")
    return folder(release) / "bin" / "python"
