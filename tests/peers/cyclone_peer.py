"""A stand-in for a ROS 2 peer with rmw_cyclonedds, which has no wheel: Cyclone DDS with names, types, user data and headers of
services as rmw_cyclonedds has them. Commands: peer.py. Runs among the packages of Jazzy, whose classes make its samples."""

import functools
import json
import os
import struct
import sys
import threading
import uuid
from pathlib import Path
from types import SimpleNamespace

import peer
from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rclpy.serialization import deserialize_message, serialize_message

HEADER = b"\0\1\0\0"
INFO = "rmw_dds_common/msg/ParticipantEntitiesInfo"
TAKEN_AT_ONCE = 100


PLAIN = {"boolean": bool, "float": types.float32, "double": types.float64, "octet": types.byte}
CALL = {"client": types.uint64, "number": types.int64}


def dds_name(name: str) -> str:
    """The name that ROS gives a type in DDS, as cyclonedds writes it."""
    package, group, name = name.split("/")
    return f"{package}.{group}.dds_.{name}_"


@functools.cache
def struct_type(name: str, raw: bool = False) -> type:
    """Of Cyclone, which checks what is written against it. With `raw` its values are CDR already."""
    if name == "tf2_msgs/msg/TFMessage":
        fields = {"transforms": types.sequence[struct_type("geometry_msgs/msg/TransformStamped")]}
    else:
        fields = peer.kinds_of(peer.found(name))
        fields = {field: idl_type(kind) for field, kind in fields.items()}
    if raw and "/srv/" in name:
        fields = {**CALL, **fields}
    made = make_idl_struct(name.split("/")[-1], dds_name(name), fields)
    if raw:
        made.__init__ = lambda self, data: setattr(self, "cdr", data)
        made.serialize = lambda self, **_: self.cdr
        made.deserialize = made.deserialize_key = classmethod(lambda _, data, **__: made(bytes(data)))
    return made


def idl_type(kind):
    form = type(kind).__name__
    if form == "BasicType":
        return PLAIN.get(kind.typename) or getattr(types, kind.typename)
    if form == "NamespacedType":
        return struct_type("/".join(kind.namespaced_name()))
    if form.endswith("String"):
        return types.bounded_str[kind.maximum_size] if form.startswith("Bounded") else str
    of = idl_type(kind.value_type)
    if form == "Array":
        return types.array[of, kind.size]
    return types.sequence[of, kind.maximum_size] if form.startswith("Bounded") else types.sequence[of]


def type_hash(name: str) -> str:
    package, group, name = name.split("/")
    file = Path(sys.prefix) / "share" / package / group / f"{name.split('_')[0]}.json"
    hashes = json.loads(file.read_text())["type_hashes"] if file.is_file() else []
    return next((each["hash_string"] for each in hashes if each["type_name"] == f"{package}/{group}/{name}"), "")


def quality(given: dict, user_data: str = "") -> Qos:
    given = {**peer.QOS, **given}
    times = {"deadline_ms": Policy.Deadline, "lease_ms": Policy.Liveliness.Automatic, "lifespan_ms": Policy.Lifespan}
    return Qos(
        Policy.Reliability.Reliable(duration(infinite=True)) if given["reliable"] else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if given["durable"] else Policy.Durability.Volatile,
        Policy.DurabilityService(0, Policy.History.KeepLast(given["depth"]), -1, -1, -1),
        Policy.History.KeepLast(given["depth"]),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(user_data.encode()),
        *(policy(given[key] * 1_000_000) for key, policy in times.items() if given[key]),
    )


class OwnNode:
    """A node with a participant of its own; tells its endpoints as ROS does."""

    def __init__(self, name: str, namespace: str):
        self.name, self.namespace = name, namespace
        self.participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]), Qos(Policy.Userdata(b"enclave=/;")))
        self.readers, self.writers = [], []
        self.info = self.writer("ros_discovery_info", INFO, {"durable": True, "depth": 1})
        self.tell()

    def topic(self, name: str, type: str, qos: Qos) -> Topic:
        return Topic(self.participant, name, struct_type(type, raw=True), qos=qos)

    def writer(self, topic: str, type: str, qos: dict) -> DataWriter:
        qos = quality(qos, f"typehash={type_hash(type)};")
        return DataWriter(self.participant, self.topic(topic, type, qos), qos=qos)

    def reader(self, topic: str, type: str, qos: dict, receive) -> DataReader:
        class Receive(Listener):
            def on_data_available(self, reader):
                for sample in reader.take(TAKEN_AT_ONCE):
                    if not isinstance(sample, InvalidSample):
                        receive(sample.cdr)

        qos = quality(qos, f"typehash={type_hash(type)};")
        return DataReader(self.participant, self.topic(topic, type, qos), qos=qos, listener=Receive())

    def tell(self) -> None:
        def gids(ends):
            return struct.pack("<I", len(ends)) + b"".join(end.guid.bytes for end in ends)

        def text(value):
            value = value.encode() + b"\0"
            return struct.pack("<I", len(value)) + value + bytes(-len(value) % 4)

        node = text(self.namespace) + text(self.name) + gids(self.readers) + gids(self.writers)
        write(self.info, HEADER + self.participant.guid.bytes + struct.pack("<I", 1) + node)

    def add(self, readers=(), writers=()) -> None:
        self.readers += readers
        self.writers += writers
        self.tell()

    def remove(self, ends) -> None:
        self.readers = [end for end in self.readers if end not in ends]
        self.writers = [end for end in self.writers if end not in ends]
        self.tell()
        for end in ends:
            end.__del__()


def write(writer: DataWriter, data: bytes) -> None:
    writer.write(writer.data_type(data))


class CyclonePeer(peer.Peer):
    def __init__(self):
        super().__init__()
        self.nodes = {}

    def close(self) -> None:
        self.ends.clear()
        for node in self.nodes.values():
            node.participant.__del__()

    def op_node(self, node, namespace="/") -> dict:
        self.nodes[node] = OwnNode(node, namespace)
        return {}

    def end(self, name, node, type, **parts) -> tuple[SimpleNamespace, OwnNode]:
        self.ends[name] = SimpleNamespace(node=node, type=type, log=peer.Log(), count=0, dds=[], **parts)
        return self.ends[name], self.nodes[node]

    def op_publisher(self, name, node, topic, type, qos) -> dict:
        end, node = self.end(name, node, type)
        writer = node.writer(f"rt{topic}", type, qos)
        end.dds, end.publish = [writer], lambda data: write(writer, data)
        end.matched = lambda: len(writer.get_matched_subscriptions())
        node.add(writers=[writer])
        return {}

    def op_subscription(self, name, node, topic, type, qos) -> dict:
        end, node = self.end(name, node, type)
        reader = node.reader(f"rt{topic}", type, qos, end.log.add)
        end.dds, end.matched = [reader], lambda: len(reader.get_matched_publications())
        node.add(readers=[reader])
        return {}

    def op_matched(self, name) -> dict:
        return {"count": self.ends[name].matched()}

    def op_destroy(self, name) -> dict:
        if name in self.nodes:
            self.ends = {other: end for other, end in self.ends.items() if end.node != name}
            self.nodes.pop(name).participant.__del__()
        else:
            end = self.ends.pop(name)
            self.nodes[end.node].remove(end.dds)
        return {}

    # --- services: 16 bytes before the CDR, guid and number of the client's request ---

    def op_server(self, name, node, service, type) -> dict:
        end, node = self.end(name, node, type)
        writer = node.writer(f"rr{service}Reply", f"{type}_Response", {})

        def serve(data):
            end.count += 1
            request = deserialize_message(HEADER + data[20:], peer.found(type).Request)
            reply = serialize_message(peer.echo(request, peer.found(type).Response()))
            write(writer, HEADER + data[4:20] + reply[4:])

        reader = node.reader(f"rq{service}Request", f"{type}_Request", {}, serve)
        end.dds = [reader, writer]
        node.add([reader], [writer])
        return {}

    def op_client(self, name, node, service, type) -> dict:
        end, node = self.end(name, node, type, guid=uuid.uuid4().bytes[:8], replies={}, arrived=threading.Condition())

        def receive(data):
            if data[4:12] == end.guid:
                with end.arrived:
                    end.replies[data[12:20]] = deserialize_message(HEADER + data[20:], peer.found(type).Response)
                    end.arrived.notify_all()

        writer = node.writer(f"rq{service}Request", f"{type}_Request", {})
        reader = node.reader(f"rr{service}Reply", f"{type}_Response", {}, receive)
        end.dds, end.writer = [reader, writer], writer
        end.available = lambda: bool(writer.get_matched_subscriptions() and reader.get_matched_publications())
        node.add([reader], [writer])
        return {}

    def op_available(self, name) -> dict:
        return {"ready": self.ends[name].available()}

    def op_call(self, name, request, timeout_ms) -> dict:
        end = self.ends[name]
        end.count += 1
        number = struct.pack("<q", end.count)
        body = serialize_message(peer.with_fields(peer.found(end.type).Request(), request))[4:]
        write(end.writer, HEADER + end.guid + number + body)
        with end.arrived:
            if not end.arrived.wait_for(lambda: number in end.replies, timeout_ms / 1e3):
                raise TimeoutError("no answer")
            return {"reply": peer.fields_of(end.replies.pop(number))}

    def op_served(self, name) -> dict:
        return {"count": self.ends[name].count}


if __name__ == "__main__":
    CyclonePeer().run("cyclonedds")
