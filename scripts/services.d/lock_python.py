#!/usr/bin/env python3
"""Writes python.lock: the versions and checksums of all Python packages that the tests use.

  scripts/services.d/lock_python.py schemathesis==4.32.5 openapi-python-client==0.29.1
  scripts/services.d/lock_python.py --of FOLDER NAME.lock     all packages of a virtual environment, into another file (from here)

The packages are those for Linux on x86_64 and the Pythons below, as the configured registry has them.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux2014_x86_64", "manylinux_2_17_x86_64", "any")
LOCK = Path(__file__).with_name("python.lock")
HEAD = """\
# Python packages with their checksums. Written by:
# scripts/services.d/lock_python.py {wanted}
"""


# empy is there as source alone, and only generates code.
UNUSED = ("pip", "setuptools", "wheel", "empy")


def installed(environment: str) -> list[str]:
    """The packages of a virtual environment."""
    folders = Path(environment, "lib").glob("python*/site-packages/*.dist-info")
    packages = (folder.stem.split("-") for folder in folders)
    return sorted(f"{name.replace('_', '-')}=={version}" for name, version in packages if name not in UNUSED)


def resolved(wanted: list[str], python: str, *options: str) -> dict[str, tuple[str, str]]:
    """Version and SHA-256 of every package that one Python needs."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        platforms = [word for platform in PLATFORMS for word in ("--platform", platform)]
        subprocess.run(
            [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--target", folder,
             "--only-binary=:all:", "--python-version", python, *platforms, "--report", report, *options, *wanted],
            check=True,
        )  # fmt: skip
        found = {}
        for package in json.loads(report.read_text())["install"]:
            data = package["metadata"]
            found[data["name"].lower().replace("_", "-")] = (
                data["version"],
                package["download_info"]["archive_info"]["hashes"]["sha256"],
            )
        return found


def main(arguments: list[str]) -> int:
    lock, wanted, options = LOCK, arguments, []
    if arguments[:1] == ["--of"] and len(arguments) == 3:
        lock, wanted, options = LOCK.parent / arguments[2], installed(arguments[1]), ["--no-deps"]
    if not wanted or any("==" not in package for package in wanted):
        print(__doc__, file=sys.stderr)
        return 2
    packages: dict[str, dict[str, list[str]]] = {}
    # Not all packages of a virtual environment are there for the newest Python.
    for python in PYTHONS[:-1] if options else PYTHONS:
        for name, (version, checksum) in resolved(wanted, python, *options).items():
            checksums = packages.setdefault(name, {}).setdefault(version, [])
            if checksum not in checksums:
                checksums.append(checksum)
    lines = [HEAD.format(wanted=" ".join(arguments))]
    for name in sorted(packages):
        [(version, checksums)] = packages[name].items()
        hashes = "".join(f" \\\n    --hash=sha256:{checksum}" for checksum in checksums)
        lines.append(f"{name}=={version}{hashes}\n")
    lock.write_text("".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
