"""Node.js and the npm packages that tests use."""

from pathlib import Path

from common import HOME, SCRIPTS, Failure

FOLDER = HOME / "node"
MODULES = HOME / "npm" / "node_modules"
PACKAGES = SCRIPTS.parent / "tests" / "clients" / "typescript"


def node() -> Path:
    return there(FOLDER / "bin" / "node")


def modules() -> Path:
    """Packages of tests/clients/typescript/package-lock.json."""
    return there(MODULES)


def there(path: Path) -> Path:
    if not path.exists():
        raise Failure(f"{path} is missing: run scripts/services install")
    return path
