"""A blaze-config of one's own: keys and a token as in earnest, an empty SQLite store, free ports. It ends with its user."""

import base64
import ctypes
import hashlib
import hmac
import json
import os
import secrets
import select
import signal
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path

from common import SCRIPTS, Failure

READY_S = 30
END_S = 10
TOKEN_S = 6 * 3600

# Two layers, with something of every kind that is in use.
DOCUMENTS = """\
kind: Layer
name: edge
labels: { site: lab }
spec: { kind: edge, config: { log: { level: info } } }
---
kind: Layer
name: fog
spec: { kind: fog, overrides: { slam: { camera: { rate_hz: 15 } } } }
---
kind: Node
name: robot-1
labels: { canary: "true" }
spec: { layer: edge, type: mobile, addresses: ["10.0.1.7"] }
---
kind: Node
name: gateway-1
spec: { layer: fog, type: gateway }
---
kind: Service
name: slam
labels: { site: lab }
spec:
  config: { camera: { rate_hz: 30 }, key: { $secret: open sesame } }
  schema: { type: object, properties: { camera: { type: object } } }
---
kind: Instance
service: slam
name: "0"
spec: { node: robot-1, config: { camera: { rate_hz: 10 } } }
"""


def binary(name: str) -> Path:
    """A program of the workspace; BLAZE_BIN_DIR says where they are, if not in target/debug."""
    target = Path(os.environ.get("CARGO_TARGET_DIR") or SCRIPTS.parent / "target")
    path = Path(os.environ.get("BLAZE_BIN_DIR") or target / "debug") / name
    if not path.exists():
        raise Failure(f"{path} is not built: run `cargo build --workspace` first")
    return path


class ConfigService:
    """Runs while the `with` block does; its files stay in the folder."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.log = folder / "blaze-config.log"
        self.rest = ""  # http://127.0.0.1:PORT
        self.admin = ""
        self.key = secrets.token_hex(32)
        self.token = self.sign("tests", ["admin"])
        self.process: subprocess.Popen | None = None

    def __enter__(self) -> "ConfigService":
        self.start()
        return self

    def start(self) -> None:
        program = binary("blaze-config")
        self.write("jwt.key", self.key)
        self.write("encryption.key", base64.b64encode(secrets.token_bytes(32)).decode())
        for old in self.folder.glob("store.db*"):
            old.unlink()
        self.write("blaze.yaml", json.dumps(self.settings()))  # JSON is YAML
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [program, "--config", self.folder / "blaze.yaml"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=log, preexec_fn=end_with_parent,
            )
        try:
            self.await_ready()
        except BaseException:
            self.end()
            raise

    def __exit__(self, *_) -> None:
        self.end()

    def settings(self) -> dict:
        free_port = "127.0.0.1:0"
        return {
            "control_plane": {
                "rest": {"listen": free_port},
                "grpc": {"listen": free_port},
                "admin": {"listen": free_port},
                "store": {"sqlite": {"path": str(self.folder / "store.db")}},
                "auth": {"keys": [{"id": "k1", "alg": "HS256", "file": str(self.folder / "jwt.key"), "sign": True}]},
                "encryption": {"keys": [{"id": "e1", "file": str(self.folder / "encryption.key")}]},
                # Requests without or with a wrong token are part of the tests.
                "limits": {"auth_failures_per_s": 0},
            }
        }

    def write(self, name: str, text: str) -> None:
        path = self.folder / name
        path.touch(mode=0o600)
        path.write_text(text + "\n")

    def await_ready(self) -> None:
        said, deadline = b"", time.monotonic() + READY_S
        output = self.process.stdout.fileno()
        while (left := deadline - time.monotonic()) > 0 and select.select([output], [], [], left)[0]:
            read = os.read(output, 4096)
            said += read
            for line in said.decode(errors="replace").splitlines(keepends=True):
                if line.startswith("ready ") and line.endswith("\n"):
                    places = dict(word.split("=", 1) for word in line.split()[1:])
                    self.rest, self.admin = f"http://{places['rest']}", f"http://{places['admin']}"
                    return
            if not read:  # it has ended
                break
        raise Failure(f"blaze-config is not ready. Its log:\n{self.tail()}")

    def end(self) -> None:
        if self.process and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(END_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def tail(self) -> str:
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-20:])

    def runs(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def sign(self, subject: str, roles: list[str]) -> str:
        """A token of HS256, as `blaze token create --key-file` makes it."""
        now = int(time.time())
        claims = {"iss": "blaze", "aud": "blaze-config", "sub": subject, "iat": now, "exp": now + TOKEN_S, "roles": roles}
        text = ".".join(_base64(json.dumps(part).encode()) for part in ({"alg": "HS256", "typ": "JWT", "kid": "k1"}, claims))
        return f"{text}.{_base64(hmac.digest(self.key.encode(), text.encode(), hashlib.sha256))}"

    def seed(self) -> None:
        """Writes documents for requests to meet."""
        headers = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/yaml"}
        request = urllib.request.Request(f"{self.rest}/api/v1/apply", DOCUMENTS.encode(), headers)
        try:
            urllib.request.urlopen(request, timeout=10).read()
        except urllib.error.HTTPError as error:
            raise Failure(f"the first documents are refused: {error.read().decode(errors='replace')}") from None

    def answers_of_rest(self) -> dict[str, int]:
        """How many requests ended in what: `ok`, or the code of the problem."""
        found: dict[str, int] = {}
        for line in urllib.request.urlopen(f"{self.admin}/metrics", timeout=10).read().decode().splitlines():
            if line.startswith("blaze_config_requests_total{") and 'api="rest"' in line:
                code = line.split('code="', 1)[1].split('"', 1)[0]
                found[code] = found.get(code, 0) + int(float(line.rsplit(" ", 1)[1]))
        return found


def _base64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


LIBC = ctypes.CDLL(None)


def end_with_parent() -> None:
    """Between fork and exec: the process is killed when this one ends, however that ends."""
    pr_set_pdeathsig = 1
    LIBC.prctl(pr_set_pdeathsig, signal.SIGKILL)
