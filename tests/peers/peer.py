"""What both peers share: commands as JSON lines on stdin, answers as JSON lines on stdout, the log of messages, and samples.

The first line of a peer is {"ready": RMW}. Each command {"op": OP, …} has one answer: what stands behind the arrow, or
{"error": TEXT}. The peer ends, and leaves its network in order, when its input ends. `node` names the node of an endpoint; a
node is a DDS participant of its own. Names of endpoints are the caller's, unique in a peer.

  node          node, namespace                            -> {}
  publisher     name, node, topic, type, qos               -> {}
  subscription  name, node, topic, type, qos               -> {}
      qos: reliable (true), durable (false), depth (10), deadline_ms, lease_ms, lifespan_ms
  publish       name, count, size, hz, seed                -> {}          starts; hz 0: without a pause
  publish       name, data                                 -> {}          one message: CDR with its header, in base64
  log           name, from                                 -> messages, busy
      what a publisher has published, or a subscription received, in order: [length, SHA-256] of each; busy: it goes on
  matched       name                                       -> count       of the other side
  destroy       name                                       -> {}          an endpoint, or a node with all of its own
  server        name, node, service, type                  -> {}          the reply has the request's fields of equal name
      only rclpy: reply (fields that it always has), delay_ms (before each reply)
  client        name, node, service, type                  -> {}
  available     name                                       -> ready       a server of that client, or an action client
  call          name, request, timeout_ms                  -> reply
  calls         names, field, count, timeout_ms            -> {}          starts: all clients at once, each one call after another
  called                                                   -> answered, faults, busy
      an integer field tells each request from all others; faults: calls without their own reply, as text
  served        name                                       -> count       of requests, goals for an action
Only rclpy:
  action_server name, node, action, step_ms (10)           -> {}          test_msgs/action/Fibonacci
  action_client name, node, action                         -> {}
  goal          name, order, timeout_ms                    -> status, feedback, sequence
  cancel        name, order, timeout_ms                    -> status      cancelled after the first feedback
  topics        node                                       -> topics      {topic: [type]}
  services      node                                       -> services    {service: [type]}
  nodes         node                                       -> nodes       with their namespaces
  endpoints     node, topic                                -> publishers, subscriptions

Both sides of a comparison log canonical CDR: options of the header 0, zeros up to a multiple of 4. DDS adds such padding.
"""

import base64
import hashlib
import importlib
import json
import random
import struct
import sys
import threading
import time
from types import SimpleNamespace

QOS = {"reliable": True, "durable": False, "depth": 10, "deadline_ms": 0, "lease_ms": 0, "lifespan_ms": 0}


class Log:
    """Length and checksum of each message, in order."""

    def __init__(self):
        self.messages = []
        self.busy = False

    def add(self, data: bytes) -> None:
        data = canonical(data)
        self.messages.append((len(data), hashlib.sha256(data).hexdigest()))


def canonical(data: bytes) -> bytes:
    return data[:2] + b"\0\0" + data[4:] + bytes(-len(data) % 4)


class Peer:
    """`op_NAME` of a subclass is a command. Endpoints have a `log`; publishers have `publish(data)`."""

    def __init__(self):
        self.ends = {}

    def op_publish(self, name, data=None, count=1, size=0, hz=0, seed=0) -> dict:
        end = self.ends[name]
        if data is not None:
            self.send(end, base64.b64decode(data))
            return {}
        end.log.busy = True
        threading.Thread(target=self.send_many, args=(end, count, size, hz, seed), daemon=True).start()
        return {}

    def send_many(self, end, count: int, size: int, hz: float, seed: int) -> None:
        start = time.monotonic()
        for number in range(count):
            self.send(end, sample(end.type, random.Random(f"{seed} {number}"), size))
            if hz:
                time.sleep(max(0, start + (number + 1) / hz - time.monotonic()))
        end.log.busy = False

    @staticmethod
    def send(end, data: bytes) -> None:
        # Before: it may arrive before `publish` returns.
        end.log.add(data)
        end.publish(data)

    def op_log(self, name, **options) -> dict:
        log = self.ends[name].log
        busy = log.busy
        return {"messages": log.messages[options.get("from", 0):], "busy": busy}  # fmt: skip

    def op_calls(self, names, field, count, timeout_ms) -> dict:
        self.calls = SimpleNamespace(answered=0, faults=[], busy=len(names), lock=threading.Lock())
        for index, name in enumerate(names):
            given = (name, field, range(index * count, (index + 1) * count), timeout_ms)
            threading.Thread(target=self.call_all, args=given, daemon=True).start()
        return {}

    def call_all(self, name, field, values, timeout_ms) -> None:
        for value in values:
            try:
                got = self.op_call(name, {field: value}, timeout_ms)["reply"][field]
                fault = None if got == value else f"{name} got {got} for {value}"
            except Exception as error:
                fault = f"{name} got {error!r} for {value}"
            with self.calls.lock:
                self.calls.answered += fault is None
                self.calls.faults += [fault] if fault else []
        with self.calls.lock:
            self.calls.busy -= 1

    def op_called(self) -> dict:
        with self.calls.lock:
            return {"answered": self.calls.answered, "faults": self.calls.faults[:10], "busy": self.calls.busy > 0}

    def run(self, rmw: str) -> None:
        print(json.dumps({"ready": rmw}), flush=True)
        for line in sys.stdin:
            command = json.loads(line)
            try:
                answer = getattr(self, f"op_{command.pop('op')}")(**command)
            except Exception as error:
                answer = {"error": repr(error)}
            print(json.dumps(answer), flush=True)
        self.close()


# --- samples --------------------------------------------------------------------------------------------------------


def found(name: str):
    """The class of package/group/Name."""
    package, group, name = name.split("/")
    name, _, part = name.partition("_")
    whole = getattr(importlib.import_module(f"{package}.{group}"), name)
    return getattr(whole, part) if part else whole


def kinds_of(message) -> dict:
    """The fields of a class or a value, and their types."""
    names = [slot.removeprefix("_") for slot in message.__slots__ if slot != "_check_fields"]
    return dict(zip(names, message.SLOT_TYPES, strict=True))


def sample(name: str, source: random.Random, size: int) -> bytes:
    """CDR of a message with random values, and about so many bytes."""
    from rclpy.serialization import serialize_message

    if name == "tf2_msgs/msg/TFMessage":
        return transforms(source, max(1, size // 100))
    message = found(name)()
    fill(message, source, size)
    return serialize_message(message)


def fill(message, source: random.Random, size: int) -> None:
    kinds = kinds_of(message)
    lists = [name for name, kind in kinds.items() if is_list(kind)]
    texts = [name for name, kind in kinds.items() if type(kind).__name__ == "UnboundedString"]
    long = lists or texts
    for name, kind in kinds.items():
        setattr(message, name, value(kind, source, size // len(long) if name in long else 12))


def is_list(kind) -> bool:
    return type(kind).__name__ == "UnboundedSequence" and hasattr(kind.value_type, "typename")


def value(kind, source: random.Random, size: int):
    form = type(kind).__name__
    if form == "NamespacedType":
        message = found("/".join(kind.namespaced_name()))()
        fill(message, source, 12)
        return message
    if form == "UnboundedString":
        return "".join(source.choices("abcdefghijklmnopqrstuvwxyz", k=size))
    if form in ("Array", "UnboundedSequence"):
        if getattr(kind.value_type, "typename", "") == "uint8" and form != "Array":
            return source.randbytes(size)
        count = kind.size if form == "Array" else max(1, size // 8)
        return [value(kind.value_type, source, size) for _ in range(count)]
    return {
        "boolean": lambda: source.random() < 0.5,
        "float": lambda: struct.unpack("f", struct.pack("f", source.random()))[0],
        "double": source.random,
    }.get(kind.typename, lambda: source.randrange(100))()


def transforms(source: random.Random, count: int) -> bytes:
    """tf2_msgs has no wheel, so its one message is written here."""
    body = struct.pack("<I", count)
    for number in range(count):
        body += bytes(-len(body) % 4) + struct.pack("<iI", source.randrange(2**31), source.randrange(10**9))
        for frame in (f"base_{number}", f"link_{source.randrange(10**9)}"):
            text = frame.encode() + b"\0"
            body += bytes(-len(body) % 4) + struct.pack("<I", len(text)) + text
        body += bytes(-len(body) % 8) + struct.pack("<7d", *(source.random() for _ in range(7)))
    return b"\0\1\0\0" + body


def echo(request, response):
    """Fields of equal name."""
    for name in kinds_of(response).keys() & kinds_of(request).keys():
        setattr(response, name, getattr(request, name))
    return response


def with_fields(message, fields: dict):
    for name, given in fields.items():
        setattr(message, name, given)
    return message


def fields_of(message) -> dict:
    """What JSON can hold of a message."""
    fields = {name: getattr(message, name) for name in kinds_of(message)}
    return {name: held for name, held in fields.items() if isinstance(held, bool | int | float | str)}
