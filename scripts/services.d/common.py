"""Places, pins and processes that installing and starting share."""

import contextlib
import dataclasses
import fcntl
import hashlib
import os
import shlex
import subprocess
import sys
from pathlib import Path

SCRIPTS = Path(__file__).resolve().parent.parent
TEMPLATES = SCRIPTS / "services.d"
HOME = Path(os.environ.get("BLAZE_SERVICES_DIR") or SCRIPTS.parent / ".services").absolute()
DOWNLOADS = HOME / "dl"
# Where a user's PATH may lack the system's own tools.
os.environ["PATH"] = f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin"


class Failure(Exception):
    """What went wrong, in words for people."""


def say(line: str) -> None:
    print(f"services: {line}", file=sys.stderr, flush=True)


@dataclasses.dataclass(frozen=True)
class Pin:
    component: str
    kind: str
    package: str
    version: str
    sha256: str
    content: str = ""  # version of what is in the package, if it is another


def pins(component: str) -> list[Pin]:
    """The lines of the pin file about one component."""
    lines = (SCRIPTS / "services.pins").read_text().splitlines()
    found = [Pin(*line.split()) for line in lines if line.strip() and not line.startswith("#")]
    return [pin for pin in found if pin.component == component]


def version(component: str) -> str:
    """Of the program, for people."""
    pin = pins(component)[0]
    return pin.content or pin.version


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def run(*command: object, **options) -> str:
    """Runs a command to its end; what it printed goes into the error if it fails."""
    words = [str(word) for word in command]
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
        )
    except FileNotFoundError:
        raise Failure(f"`{words[0]}` is missing on this machine") from None
    if done.returncode != 0:
        tail = "\n".join(done.stdout.splitlines()[-20:])
        raise Failure(f"`{shlex.join(words)}` failed ({done.returncode}):\n{tail}")
    return done.stdout


@contextlib.contextmanager
def exclusive():
    """One install, start or stop at a time; another waits."""
    HOME.mkdir(parents=True, exist_ok=True)
    with (HOME / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
