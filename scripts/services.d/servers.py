"""Starts, watches and stops the servers that all tests of a run share. Each has a folder .services/run/NAME with its
configuration, data, log, and the files `pid` (number and start time of the process) and `port`."""

import dataclasses
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import wire
from common import HOME, TEMPLATES, Failure, say, version

RUN = HOME / "run"
ENVIRONMENT = HOME / "env"
START_DEADLINE_S = 60
STOP_DEADLINE_S = 10
PORT_ATTEMPTS = 3
LOG_LINES = 20
# Below the range that Linux gives to outgoing connections: a client that retries while its server is down can neither
# take the server's port nor, on loopback, connect to itself.
PORTS = range(20_000, 32_000)


@dataclasses.dataclass
class Server:
    name: str
    component: str
    variable: str
    address: str  # with {port}
    port: int = 0

    # --- what differs among the servers

    def prepare(self) -> None:
        """Writes the configuration for self.port."""

    def command(self) -> list[object]:
        raise NotImplementedError

    def program(self) -> Path:
        return HOME / "bin" / self.command()[0]

    def is_ready(self) -> bool:
        """Asks the server, and makes sure that it is this one: another on the same port would answer as well."""
        raise NotImplementedError

    def set_up(self) -> bool:
        """What is done once after the start; called until it says that the server is ready."""
        return self.is_ready()

    # --- places

    @property
    def folder(self) -> Path:
        return RUN / self.name

    @property
    def log(self) -> Path:
        return self.folder / "log"

    def log_tail(self) -> str:
        lines = self.log.read_text(errors="replace").splitlines() if self.log.exists() else []
        return "\n".join(lines[-LOG_LINES:])

    # --- the process

    def pid(self) -> int | None:
        """Of the process that was started, if it is still the same one."""
        try:
            pid, started = (self.folder / "pid").read_text().split()
            self.port = int((self.folder / "port").read_text())
        except (OSError, ValueError):
            return None
        return int(pid) if start_time(int(pid)) == started else None

    def answers(self) -> bool:
        return tried(self.is_ready)

    def start(self) -> None:
        begin = time.monotonic()
        if self.pid():
            self.wait(self.answers)
            say(f"{self.name}: runs already on port {self.port}")
            return
        if not self.program().exists():
            raise Failure(f"{self.name}: {self.program()} is missing: run scripts/services install")
        self.folder.mkdir(parents=True, exist_ok=True)
        for attempt in range(1, PORT_ATTEMPTS + 1):
            self.choose_port()
            try:
                self.spawn()
                self.wait(lambda: tried(self.set_up))
                break
            except Failure:
                self.stop()
                if attempt == PORT_ATTEMPTS or "in use" not in self.log_tail():
                    raise
        say(f"{self.name}: port {self.port}, ready after {time.monotonic() - begin:.1f} s")

    def choose_port(self) -> None:
        """That of the kept data if it is free, else any."""
        noted = self.folder / "port"
        kept = int(noted.read_text()) if noted.exists() else 0
        self.port = kept if kept and is_free(kept) else free_port()
        if kept and kept != self.port:
            self.port_has_changed()
        noted.write_text(f"{self.port}\n")

    def port_has_changed(self) -> None:
        """The data stays; only the port is another."""

    def spawn(self) -> None:
        self.prepare()
        self.log.unlink(missing_ok=True)
        with self.log.open("w") as log:
            words = [str(self.program()), *(str(word) for word in self.command()[1:])]
            process = subprocess.Popen(
                words, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        (self.folder / "pid").write_text(f"{process.pid} {start_time(process.pid)}\n")
        self.process = process  # so that its end is noticed, and it does not stay as a zombie

    def wait(self, condition) -> None:
        deadline = time.monotonic() + START_DEADLINE_S
        while not condition():
            process = getattr(self, "process", None)
            if (process and process.poll() is not None) or not self.pid():
                raise Failure(f"{self.name}: ended. Its log:\n{self.log_tail()}")
            if time.monotonic() > deadline:
                raise Failure(f"{self.name}: not ready within {START_DEADLINE_S} s. Its log:\n{self.log_tail()}")
            time.sleep(0.02)

    def stop(self, deadline_s: float = STOP_DEADLINE_S) -> None:
        """SIGTERM, and SIGKILL if that does not help. Returns when the process has ended."""
        pid = self.pid()
        if not pid:
            return
        os.kill(pid, signal.SIGTERM)
        os.kill(pid, signal.SIGCONT)
        if not self.ends_within(deadline_s):
            say(f"{self.name}: does not end, killing it")
            os.kill(pid, signal.SIGKILL)
            self.ends_within(STOP_DEADLINE_S)

    def ends_within(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if process := getattr(self, "process", None):
                process.poll()
            if not self.pid():
                return True
            time.sleep(0.02)
        return False


class Redis(Server):
    def command(self) -> list[object]:
        # Large messages to a slow reader: the default of 32 MiB for a subscriber cuts it off.
        limit = ["--client-output-buffer-limit", "pubsub 256mb 128mb 60"]
        return [f"{self.component}-server", "--port", self.port, "--bind", "127.0.0.1", "--dir", self.folder,
                "--save", "", "--appendonly", "no", *limit, "--loglevel", "notice"]

    def is_ready(self) -> bool:
        return wire.redis_pid(self.port) == self.pid()


class Kafka(Server):
    classes = HOME / "kafka" / "classes.jsa"

    def program(self) -> Path:
        return HOME / "jre" / "bin" / "java"

    def prepare(self) -> None:
        data = self.folder / "data"
        if not data.exists():
            formatted = HOME / "kafka" / "formatted"
            if not formatted.exists():
                raise Failure(f"{self.name}: {formatted} is missing: run scripts/services install")
            shutil.copytree(formatted, data)
            give_cluster_id(data / "meta.properties")
        text = (TEMPLATES / "kafka.properties").read_text()
        for word, value in (("@PORT@", self.port), ("@CONTROLLER_PORT@", free_port()), ("@DATA@", data)):
            text = text.replace(word, str(value))
        (self.folder / "server.properties").write_text(text)

    def command(self) -> list[object]:
        logging = TEMPLATES / "kafka.log4j2.properties"
        return ["java", f"@{TEMPLATES / 'kafka.java-options'}", *self.archive(), f"-Dlog4j2.configurationFile={logging}",
                "-cp", f"{HOME}/kafka/libs/*", "kafka.Kafka", "server.properties"]

    def archive(self) -> list[str]:
        """Classes as Java has them in memory: half the time to start. Java does without if they do not fit."""
        return [f"-XX:SharedArchiveFile={self.classes}"] if self.classes.exists() else []

    def is_ready(self) -> bool:
        identity = wire.kafka_cluster(self.port)
        return f"cluster.id={identity}" in (self.folder / "data" / "meta.properties").read_text().splitlines()

    def set_up(self) -> bool:
        return self.is_ready() and wire.kafka_warm(self.port)


class ClassArchive(Kafka):
    """A broker that only lives to write the archive which the others start from."""

    def archive(self) -> list[str]:
        return [f"-XX:ArchiveClassesAtExit={self.classes}"]

    def write(self) -> bool:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.choose_port()
            self.spawn()
            self.wait(lambda: tried(self.set_up))
        finally:
            self.stop(START_DEADLINE_S)
            shutil.rmtree(self.folder, ignore_errors=True)
        return self.classes.exists()


class Mongo(Server):
    def command(self) -> list[object]:
        return ["mongod", "--dbpath", self.folder / "data", "--port", self.port, "--bind_ip", "127.0.0.1",
                "--replSet", "rs0", "--oplogSize", "64", "--wiredTigerCacheSizeGB", "0.25", "--nounixsocket",
                "--setParameter", "diagnosticDataCollectionEnabled=false"]

    def prepare(self) -> None:
        (self.folder / "data").mkdir(exist_ok=True)

    def port_has_changed(self) -> None:
        say(f"{self.name}: its port was taken, and is part of its data: starts empty")
        shutil.rmtree(self.folder / "data", ignore_errors=True)

    def set_up(self) -> bool:
        return wire.mongo_pid(self.port) == self.pid() and wire.mongo_initiate(self.port) and self.is_ready()

    def is_ready(self) -> bool:
        return wire.mongo_pid(self.port) == self.pid() and wire.mongo_writable(self.port)


SERVERS: list[Server] = [
    Redis("redis", "redis", "BLAZE_TEST_REDIS_URL", "redis://127.0.0.1:{port}"),
    Redis("valkey", "valkey", "BLAZE_TEST_VALKEY_URL", "redis://127.0.0.1:{port}"),
    Kafka("kafka-fog", "kafka", "BLAZE_TEST_KAFKA_FOG", "127.0.0.1:{port}"),
    Kafka("kafka-cloud", "kafka", "BLAZE_TEST_KAFKA_CLOUD", "127.0.0.1:{port}"),
    Mongo("mongo", "mongo", "BLAZE_TEST_MONGODB_URI", "mongodb://127.0.0.1:{port}/?replicaSet=rs0"),
]


def start() -> int:
    begin = time.monotonic()
    with ThreadPoolExecutor(len(SERVERS)) as pool:
        jobs = [pool.submit(server.start) for server in SERVERS]
    failures = [job.exception() for job in jobs if job.exception()]
    for failure in failures:
        say(str(failure) if isinstance(failure, Failure) else repr(failure))
    if failures:
        return 1
    lines = [f"{server.variable}={server.address.format(port=server.port)}\n" for server in SERVERS]
    new = ENVIRONMENT.with_suffix(".new")
    new.write_text("".join(lines))
    new.rename(ENVIRONMENT)
    say(f"all ready in {time.monotonic() - begin:.1f} s, addresses in {ENVIRONMENT}")
    return 0


def stop(keep: bool) -> int:
    # First, so that no test takes an address of a server that is about to end.
    ENVIRONMENT.unlink(missing_ok=True)
    with ThreadPoolExecutor(len(SERVERS)) as pool:
        for job in [pool.submit(server.stop) for server in SERVERS]:
            job.result()
    left = [server.name for server in SERVERS if server.pid()]
    if left:
        raise Failure(f"still running: {' '.join(left)}")
    if not keep:
        shutil.rmtree(RUN, ignore_errors=True)
    say("stopped, data kept" if keep else "stopped")
    return 0


def status() -> int:
    all_ready = True
    print(f"{'NAME':<12} {'PID':>8} {'PORT':>6} {'VERSION':<12} {'READY':<6} {'RSS/MiB':>8}")
    for server in SERVERS:
        pid = server.pid()
        ready = pid is not None and server.answers()
        all_ready &= ready
        port = server.port if pid else "-"
        row = f"{server.name:<12} {pid or '-':>8} {port:>6} {version(server.component):<12} "
        print(f"{row}{'yes' if ready else 'no':<6} {resident_mib(pid):>8}")
    return 0 if all_ready else 1


def tried(ask) -> bool:
    """What a server says; False while it is not there or says what makes no sense."""
    try:
        return ask()
    except (OSError, ValueError, IndexError, KeyError, struct.error):
        return False


# --- the system -----------------------------------------------------------------------------------------------------


def start_time(pid: int) -> str | None:
    """Clock ticks from the start of the machine to that of the process; None for one that has ended."""
    try:
        # The name in parentheses may hold blanks; after it comes field 3, the state.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else fields[19]


def resident_mib(pid: int | None) -> str:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return "-"
    return next((str(int(line.split()[1]) // 1024) for line in lines if line.startswith("VmRSS:")), "-")


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


def free_port() -> int:
    for port in random.sample(PORTS, 1000):
        if is_free(port):
            return port
    raise Failure(f"no free port from {PORTS.start} to {PORTS.stop - 1}")


def give_cluster_id(properties: Path) -> None:
    """22 characters, the form of Kafka's own identities: two clusters must not be taken for one."""
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"
    identity = "".join(random.choices(letters, k=22))
    lines = properties.read_text().splitlines()
    changed = [f"cluster.id={identity}" if line.startswith("cluster.id=") else line for line in lines]
    properties.write_text("\n".join(changed) + "\n")
