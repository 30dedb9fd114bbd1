"""Just enough of each server's protocol to ask whether it is ready, and to set it up. No client libraries needed.

A function raises OSError while the server is not there yet, and ValueError, IndexError or struct.error for an answer
that makes no sense."""

import socket
import struct

TIMEOUT = 2.0
MAX_ANSWER = 16 << 20


def connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT)


def receive(connection: socket.socket, count: int) -> bytes:
    if not 0 <= count <= MAX_ANSWER:
        raise ValueError(f"an answer of {count} bytes")
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise ConnectionError("closed within an answer")
        data += part
    return data


# --- Redis ----------------------------------------------------------------------------------------------------------


def redis_pid(port: int) -> int:
    """Process that answers on the port; 0 while it still reads its data."""
    with connect(port) as connection:
        connection.sendall(b"*2\r\n$4\r\nINFO\r\n$6\r\nserver\r\n")
        start = connection.recv(64)
        if not start.startswith(b"$"):
            return 0
        head, _, data = start.partition(b"\r\n")
        text = data + receive(connection, int(head[1:]) - len(data))
    return int(text.partition(b"process_id:")[2].split()[0])


# --- Kafka ----------------------------------------------------------------------------------------------------------

METADATA, OFFSET_FETCH, FIND_COORDINATOR, INIT_PRODUCER_ID = 3, 9, 10, 22


class Answer:
    """Fields of an answer, one after another."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def number(self, form: str) -> int:
        size = struct.calcsize(f">{form}")
        if self.at + size > len(self.data):
            raise ValueError("an answer that is too short")
        [value] = struct.unpack_from(f">{form}", self.data, self.at)
        self.at += size
        return value

    def text(self) -> str:
        length = max(self.number("h"), 0)
        self.at += length
        return self.data[self.at - length : self.at].decode()


def kafka_call(port: int, key: int, version: int, body: bytes) -> Answer:
    request = struct.pack(">hhih", key, version, 1, -1) + body
    with connect(port) as connection:
        connection.sendall(struct.pack(">i", len(request)) + request)
        [length] = struct.unpack(">i", receive(connection, 4))
        answer = Answer(receive(connection, length))
    answer.number("i")  # correlation
    return answer


def kafka_text(value: str) -> bytes:
    return struct.pack(">h", len(value)) + value.encode()


def kafka_cluster(port: int) -> str:
    """Identity of the cluster; empty while the only broker has not been let in by the controller."""
    answer = kafka_call(port, METADATA, 2, struct.pack(">i", 0))
    brokers = answer.number("i")
    for _ in range(brokers):
        answer.number("i")  # node
        answer.text()  # host
        answer.number("i")  # port
        answer.text()  # rack
    cluster = answer.text()
    return cluster if brokers else ""


def kafka_warm(port: int) -> bool:
    """One step towards the first consumer group and the first idempotent producer, for which the broker makes a topic
    and takes a block of identities. Call until True; the tests need not wait for it then."""
    coordinator = kafka_call(port, FIND_COORDINATOR, 1, kafka_text("warm-up") + b"\0")
    coordinator.number("i")  # throttle
    if coordinator.number("h") != 0:
        return False
    offsets = kafka_call(port, OFFSET_FETCH, 2, kafka_text("warm-up") + struct.pack(">i", -1))
    if offsets.number("i") != 0 or offsets.number("h") != 0:
        return False
    producer = kafka_call(port, INIT_PRODUCER_ID, 0, struct.pack(">hi", -1, 60_000))
    producer.number("i")  # throttle
    return producer.number("h") == 0


# --- MongoDB --------------------------------------------------------------------------------------------------------

OP_MSG = 2013
ALREADY_INITIALIZED = 23


def mongo_initiate(port: int) -> bool:
    """Makes the server a replica set of one. True when it is one."""
    member = {"_id": 0, "host": f"127.0.0.1:{port}"}
    answer = mongo_command(port, {"replSetInitiate": {"_id": "rs0", "members": [member]}, "$db": "admin"})
    return answer.get("ok") == 1 or answer.get("code") == ALREADY_INITIALIZED


def mongo_pid(port: int) -> int:
    """Process that answers on the port."""
    return mongo_command(port, {"serverStatus": 1, "repl": 0, "metrics": 0, "$db": "admin"})["pid"]


def mongo_writable(port: int) -> bool:
    return mongo_command(port, {"hello": 1, "$db": "admin"}).get("isWritablePrimary") is True


def mongo_command(port: int, command: dict) -> dict:
    body = struct.pack("<iB", 0, 0) + bson(command)
    with connect(port) as connection:
        connection.sendall(struct.pack("<iiii", 16 + len(body), 1, 0, OP_MSG) + body)
        [length] = struct.unpack("<i", receive(connection, 4))
        message = receive(connection, length - 4)
    return scalars(message[12 + 5 :])


def bson(document: dict) -> bytes:
    """Of text, whole numbers, documents and lists."""
    body = b"".join(bson_element(name, value) for name, value in document.items())
    return struct.pack("<i", len(body) + 5) + body + b"\0"


def bson_element(name: str, value) -> bytes:
    key = name.encode() + b"\0"
    match value:
        case str():
            text = value.encode() + b"\0"
            return b"\x02" + key + struct.pack("<i", len(text)) + text
        case int():
            return b"\x10" + key + struct.pack("<i", value)
        case dict():
            return b"\x03" + key + bson(value)
        case list():
            return b"\x04" + key + bson({str(index): item for index, item in enumerate(value)})
    raise TypeError(f"no BSON for {value!r}")


# Types of BSON and their lengths; -1: the first four bytes are the length of all, -2: of what follows them.
BSON_SIZES = {1: 8, 2: -2, 3: -1, 4: -1, 7: 12, 8: 1, 9: 8, 10: 0, 16: 4, 17: 8, 18: 8}
BSON_BINARY = 5


def scalars(document: bytes) -> dict:
    """The numbers, truth values and texts of a document's top level."""
    found, at = {}, 4
    while at < len(document) and (kind := document[at]):
        end = document.index(0, at + 1)
        name = document[at + 1 : end].decode()
        at = end + 1
        size = BSON_SIZES.get(kind)
        if kind == BSON_BINARY:
            size = struct.unpack_from("<i", document, at)[0] + 5
        elif size is None:
            raise ValueError(f"BSON type {kind}")
        elif size < 0:
            size = struct.unpack_from("<i", document, at)[0] + (4 if size == -2 else 0)
        value = document[at : at + size]
        match kind:
            case 1:
                found[name] = struct.unpack("<d", value)[0]
            case 2:
                found[name] = value[4:-1].decode()
            case 8:
                found[name] = value == b"\1"
            case 16 | 18:
                found[name] = int.from_bytes(value, "little", signed=True)
        at += size
    return found
