"""Random values of every type of a release, through rosbags, rclpy and blaze-convert; started by scripts/ros-oracle.

A value is a tree: dict, list, bool, int, str, float, `F32`, and bytes for many of `uint8`, `byte` or `char`. It becomes a
message of rosbags or rclpy on one side, and the JSON of docs/json-and-ros2-types.md on the other.
"""

import base64
import importlib
import json
import math
import random
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

INTEGERS = {f"{sign}int{bits}": (0 if sign else -(2 ** (bits - 1)), 2 ** (bits if sign else bits - 1) - 1)
            for sign in ("", "u") for bits in (8, 16, 32, 64)}  # fmt: skip
BYTES = ("uint8", "byte", "char")
CHARACTERS = "abc xyz019 \"'\\/\n\t\x01\x7féßЖ中\u2028\ufffd😀"
SEED = 20_261_128


class F32(float):
    """A value of float32."""


class Values:
    """Makes random values. A kind is `(name,)` of a plain type, `("string"|"wstring", bound)`, `("message", name)`,
    `("array", size, kind)` or `("sequence", bound, kind)`; bounds are 0 for none."""

    def __init__(self, fields, most_byte: int):
        self.fields = fields
        self.most_byte = most_byte
        self.random = random.Random(SEED)

    def message(self, name: str, depth: int = 0) -> dict:
        return {field: self.value(kind, depth) for field, kind in self.fields(name)}

    def value(self, kind: tuple, depth: int):
        match kind:
            case ("message", name):
                return self.message(name, depth + 1)
            case ("array", size, of):
                return self.many(of, size, depth)
            case ("sequence", bound, of):
                most = 4 if depth < 2 else 1
                return self.many(of, self.random.randint(0, min(bound or most, most)), depth)
            case ("string" | "wstring", bound):
                return self.text(bound)
            case (plain,):
                return self.plain(plain)

    def many(self, kind: tuple, size: int, depth: int):
        if kind[0] in BYTES:
            return bytes(self.plain(kind[0]) for _ in range(size))
        return [self.value(kind, depth) for _ in range(size)]

    def text(self, bound: int) -> str:
        text = "".join(self.random.choices(CHARACTERS, k=self.random.randint(0, 9)))
        while bound and len(text.encode()) > bound:
            text = text[:-1]
        return text

    def plain(self, name: str):
        if name == "bool":
            return self.random.random() < 0.5
        if name in BYTES:
            return self.random.randint(0, self.most_byte if name == "byte" else 255)
        if name in INTEGERS:
            low, high = INTEGERS[name]
            return self.random.choice((low, high, 0, self.random.randint(low, high), self.random.randint(low, high)))
        bits = self.random.getrandbits(64)
        if name == "float32":
            value = struct.unpack("<f", struct.pack("<I", bits & 0xFFFF_FFFF))[0]
            return F32(math.nan if math.isnan(value) else value)
        if name == "float64":
            value = struct.unpack("<d", struct.pack("<Q", bits))[0]
            easy = self.random.choice((0.0, -0.0, 1.0, 0.1, math.inf, -math.inf, math.nan, round(self.random.uniform(-9, 9), 3)))
            return easy if self.random.random() < 0.5 or math.isnan(value) else value
        raise ValueError(name)


def as_json(value):
    """What the table asks for."""
    if isinstance(value, dict):
        return {name: as_json(member) for name, member in value.items()}
    if isinstance(value, list):
        return [as_json(element) for element in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def shuffled(value, order: random.Random):
    if isinstance(value, dict):
        names = list(value)
        order.shuffle(names)
        return {name: shuffled(value[name], order) for name in names}
    return [shuffled(element, order) for element in value] if isinstance(value, list) else value


def same(expected, found) -> bool:
    if isinstance(expected, dict):
        return isinstance(found, dict) and list(expected) == list(found) and all(
            same(value, found[name]) for name, value in expected.items())  # fmt: skip
    if isinstance(expected, list):
        return isinstance(found, list) and len(expected) == len(found) and all(map(same, expected, found))
    if isinstance(expected, F32):
        return type(found) is float and numpy.float32(found).tobytes() == numpy.float32(expected).tobytes()
    if isinstance(expected, float):
        return type(found) is float and struct.pack("<d", found) == struct.pack("<d", expected)
    return type(expected) is type(found) and expected == found


class Convert:
    """The program that is tested."""

    def __init__(self, program: str, release: str, *folders: str):
        self.command = [program, release, *folders]

    def ask(self, tasks: list[tuple[str, str, bytes]]) -> list[bytes | str]:
        """The answers: bytes, or the text of an error."""
        lines = (f"{name}\t{task}\t{base64.b64encode(data).decode()}\n" for name, task, data in tasks)
        done = subprocess.run(self.command, input="".join(lines).encode(), capture_output=True, check=True)
        answers = []
        for line in done.stdout.decode().splitlines():
            word, _, text = line.partition("\t")
            answers.append(base64.b64decode(text) if word == "ok" else text)
        return answers

    def hashes(self, names: list[str]) -> list[str]:
        lines = "".join(f"{name}\thash\t\n" for name in names).encode()
        done = subprocess.run(self.command, input=lines, capture_output=True, check=True)
        return [line.partition("\t")[2] for line in done.stdout.decode().splitlines()]


class Rosbags:
    """Messages of rosbags' own definitions."""

    def __init__(self, release: str):
        self.store = get_typestore(Stores[f"ROS2_{release.upper()}"])
        # It refuses a `byte` above 127, and writes nothing for a message without fields.
        self.values = Values(self.fields, most_byte=127)
        self.names = [name for name in sorted(self.store.types) if not name.startswith("rosbag2_") and not self.has_empty(name)]

    def fields(self, name: str):
        fields = self.store.fielddefs[name][1]
        return [(field, self.kind(kind)) for field, kind in fields if field != "structure_needs_at_least_one_member"]

    def kind(self, found) -> tuple:
        node, about = found
        if node == Nodetype.BASE:
            name, bound = about if isinstance(about, tuple) else (about, 0)
            return (name, bound) if name in ("string", "wstring") else (name,)
        if node == Nodetype.NAME:
            return ("message", about)
        of, size = about
        return ("array" if node == Nodetype.ARRAY else "sequence", size or 0, self.kind(of))

    def has_empty(self, name: str) -> bool:
        fields = self.fields(name)
        nested = [kind[-1] if kind[0] in ("array", "sequence") else kind for _, kind in fields]
        names = [kind[1] for kind in nested if kind[0] == "message"]
        return not fields or any(self.has_empty(each) for each in names)

    def has_char(self, name: str) -> bool:
        kinds = [kind[-1] if kind[0] in ("array", "sequence") else kind for _, kind in self.fields(name)]
        return ("char",) in kinds or any(self.has_char(kind[1]) for kind in kinds if kind[0] == "message")

    def message(self, name: str, value: dict):
        return self.store.types[name](**{field: self.made(kind, value[field]) for field, kind in self.fields(name)})

    def made(self, kind: tuple, value):
        if kind[0] == "message":
            return self.message(kind[1], value)
        if kind[0] not in ("array", "sequence"):
            return value
        of = kind[2]
        if of[0] in ("message", "string", "wstring"):
            return [self.made(of, element) for element in value]
        types = {"bool": "bool", "byte": "uint8", "char": "uint8"}
        return numpy.array(list(value), dtype=types.get(of[0], of[0]))

    def cdr(self, name: str, value: dict) -> bytes:
        return bytes(self.store.serialize_cdr(self.message(name, value), name))


class Rclpy:
    """Classes of the packages that are installed, with Fast DDS."""

    def __init__(self, share: Path):
        import rclpy.serialization

        self.serialization = rclpy.serialization
        self.classes = {}
        for file in sorted(share.glob("*/*/*.json")):
            package, group = file.parts[-3:-1]
            if group in ("msg", "srv", "action") and file.with_suffix(f".{group}").is_file():
                found = getattr(importlib.import_module(f"{package}.{group}"), file.stem)
                self.add(f"{package}/{group}/{file.stem}", found, group)
        self.values = Values(self.fields, most_byte=255)
        self.names = list(self.classes)

    def add(self, name: str, found, group: str) -> None:
        if group == "msg":
            self.classes[name] = found
        elif group == "srv":
            for part in ("Request", "Response", "Event"):
                self.classes[f"{name}_{part}"] = getattr(found, part)
        else:
            for part in ("Goal", "Result", "Feedback"):
                self.classes[f"{name}_{part}"] = getattr(found, part)
            self.add(f"{name}_SendGoal", found.Impl.SendGoalService, "srv")
            self.add(f"{name}_GetResult", found.Impl.GetResultService, "srv")
            self.classes[f"{name}_FeedbackMessage"] = found.Impl.FeedbackMessage

    def fields(self, name: str):
        found = self.classes[name]
        # A debugging aid of the classes is no field.
        names = [slot.lstrip("_") for slot in found.__slots__ if slot != "_check_fields"]
        return [(field, self.kind(kind)) for field, kind in zip(names, found.SLOT_TYPES, strict=True)]

    def kind(self, found) -> tuple:
        form = type(found).__name__
        if form == "BasicType":
            return ({"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}.get(found.typename, found.typename),)
        if form == "NamespacedType":
            return ("message", "/".join(found.namespaced_name()))
        if form == "Array":
            return ("array", found.size, self.kind(found.value_type))
        if form.endswith("Sequence"):
            return ("sequence", getattr(found, "maximum_size", 0), self.kind(found.value_type))
        return ("wstring" if form.endswith("WString") else "string", getattr(found, "maximum_size", 0))

    def message(self, name: str, value: dict):
        message = self.classes[name]()
        for field, kind in self.fields(name):
            setattr(message, field, self.made(kind, value[field]))
        return message

    def made(self, kind: tuple, value):
        if kind[0] == "message":
            return self.message(kind[1], value)
        if kind[0] == "byte":
            return bytes([value])
        if kind[0] in ("array", "sequence"):
            return [self.made(kind[2], element) for element in value]
        return float(value) if isinstance(value, F32) else value

    def cdr(self, name: str, value: dict) -> bytes:
        return self.serialization.serialize_message(self.message(name, value))

    def default(self, name: str) -> bytes:
        return self.serialization.serialize_message(self.classes[name]())

    def again(self, name: str, cdr: bytes) -> bytes:
        message = self.serialization.deserialize_message(cdr, self.classes[name])
        return self.serialization.serialize_message(message)


SAMPLES = """
test_msgs/msg/BasicTypes test_msgs/msg/Strings test_msgs/msg/WStrings test_msgs/msg/Defaults test_msgs/msg/Empty
test_msgs/msg/BoundedPlainSequences test_msgs/msg/Nested sensor_msgs/msg/Imu diagnostic_msgs/msg/DiagnosticArray
rcl_interfaces/msg/Parameter nav_msgs/srv/GetPlan_Request service_msgs/msg/ServiceEventInfo
""".split()


def definition(share: Path, name: str) -> str:
    """Text of a message and of all that it refers to in its own package."""
    package, _, file = name.split("/")
    lines = [line.split("#")[0].strip() for line in (share / package / "msg" / f"{file}.msg").read_text().splitlines()]
    text = "".join(f"{line}\n" for line in lines if line)
    nested = {line.split()[0].split("[")[0] for line in lines if line[:1].isupper()}
    return text + "".join(f"===\nMSG: {package}/{each}\n{definition(share, f'{package}/msg/{each}')}" for each in sorted(nested))


def samples() -> None:
    """What the tests of blaze-convert read without Python: convert/src/program/samples.json."""
    share = Path(sys.prefix) / "share"
    rclpy = Rclpy(share)
    made = []
    for name in SAMPLES:
        package, group, file = name.split("/")
        hashes = json.loads((share / package / group / f"{file.split('_')[0]}.json").read_text())["type_hashes"]
        value = rclpy.values.message(name)
        made.append({
            "type": name,
            "definition": definition(share, name) if package == "test_msgs" else None,
            "hash": next(each["hash_string"] for each in hashes if each["type_name"] == name),
            "cdr": base64.b64encode(rclpy.cdr(name, value)).decode(),
            "json": shortest(as_json(value)),
        })  # fmt: skip
    print("[\n" + ",\n".join(json.dumps(each, ensure_ascii=False, separators=(",", ":")) for each in made) + "\n]")


def shortest(value):
    """float32 with as many digits as it needs."""
    if isinstance(value, dict):
        return {name: shortest(member) for name, member in value.items()}
    if isinstance(value, list):
        return [shortest(element) for element in value]
    return float(str(numpy.float32(value))) if isinstance(value, F32) else value


class Report:
    def __init__(self):
        self.faults = []

    def check(self, good: bool, *about) -> None:
        if not good:
            self.faults.append(about)
            if len(self.faults) <= 20:
                print("DIFFERENT", *(str(each)[:300] for each in about), file=sys.stderr)


def compare(convert: Convert, other, count: int, report: Report) -> int:
    """Values of all types of the other. How many."""
    order = random.Random(SEED)
    exact = isinstance(other, Rosbags)
    total = 0
    for name in other.names:
        values = [other.values.message(name) for _ in range(count)]
        cdrs = [other.cdr(name, value) for value in values]
        texts = [as_json(value) for value in values]
        asked = [json.dumps(text if index % 2 else shuffled(text, order)).encode() for index, text in enumerate(texts)]
        tasks = [(name, "json", cdr) for cdr in cdrs] + [(name, "cdr", text) for text in asked]
        answers = convert.ask(tasks)
        for cdr, text, to_json, to_cdr in zip(cdrs, texts, answers[:count], answers[count:], strict=True):
            good = isinstance(to_json, bytes) and same(text, json.loads(to_json))
            report.check(good, name, "to JSON", text, to_json, cdr.hex())
            report.check(isinstance(to_cdr, bytes) and (not exact or to_cdr == cdr), name, "to CDR", text, to_cdr, cdr.hex())
        if not exact:
            compare_read(convert, other, name, texts, answers[count:], report)
        total += count
    return total


def compare_read(convert: Convert, other: Rclpy, name: str, texts: list, cdrs: list, report: Report) -> None:
    """Padding of Fast DDS holds anything, so it reads our bytes and writes them again."""
    read = [other.again(name, cdr) for cdr in cdrs if isinstance(cdr, bytes)]
    [empty] = convert.ask([(name, "cdr", b"{}")])
    answers = convert.ask([(name, "json", cdr) for cdr in [*read, other.default(name), empty]])
    for text, answer in zip(texts, answers, strict=False):
        good = isinstance(answer, bytes) and same(text, json.loads(answer))
        report.check(good, name, "our CDR read by rclpy", text, answer)
    report.check(answers[-2] == answers[-1], name, "defaults", *answers[-2:])


def compare_hashes(program: str, release: str, share: Path, report: Report) -> int:
    """Hashes of the `share` tree: of its type descriptions, of its texts, of what is built in."""
    known = {}
    for file in share.glob("*/*/*.json"):
        if file.parent.name in ("msg", "srv", "action"):
            hashes = json.loads(file.read_text()).get("type_hashes", [])
            known |= {each["type_name"]: each["hash_string"] for each in hashes}
    names = sorted(known)
    with tempfile.TemporaryDirectory() as texts:
        for file in share.glob("*/*/*"):
            if file.suffix == f".{file.parent.name}":
                folder = Path(texts, *file.parts[-3:-1])
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, folder)
        built_in = [name for name in names if not name.startswith("test_msgs/")]
        # Some types of test_msgs are there as IDL alone.
        texted = [name for name in names if has_text(Path(texts), name)]
        ways = (("descriptions", [str(share)], names), ("texts", [texts], texted), ("built in", [], built_in))
        for kind, folders, asked in ways:
            found = Convert(program, release, *folders).hashes(asked)
            for name, text in zip(asked, found, strict=True):
                report.check(text == known[name], name, "hash", kind, text, known[name])
    return len(names)


def has_text(folder: Path, name: str) -> bool:
    package, group, part = name.split("/")
    return (folder / package / group / f"{part if group == 'msg' else part.split('_')[0]}.{group}").is_file()


def main() -> int:
    if sys.argv[1] == "samples":
        samples()
        return 0
    release, count, program = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    report = Report()
    rosbags = Rosbags(release)
    hashes = Convert(program, release).hashes(rosbags.names)
    for name, found in zip(rosbags.names, hashes, strict=True):
        # It takes `char` for another kind than ROS 2 does.
        if not rosbags.has_char(name):
            report.check(found == rosbags.store.hash_rihs01(name), name, "hash of rosbags", found)
    total = compare(Convert(program, release), rosbags, count, report)
    print(f"{release}: rosbags {len(rosbags.names)} types, {total} values, {len(hashes)} hashes", file=sys.stderr)
    if release != "humble":
        share = Path(sys.prefix) / "share"
        rclpy = Rclpy(share)
        total = compare(Convert(program, release, str(share)), rclpy, count, report)
        hashes = compare_hashes(program, release, share, report)
        print(f"{release}: rclpy {len(rclpy.names)} types, {total} values; {hashes} hashes of the share tree, three ways", file=sys.stderr)
    print(f"{release}: {len(report.faults)} differences", file=sys.stderr)
    return 1 if report.faults else 0


if __name__ == "__main__":
    sys.exit(main())
