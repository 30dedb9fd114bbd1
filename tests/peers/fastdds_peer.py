"""A peer without ROS: Fast DDS alone, in C++ (fastdds_peer.cpp), a process for each node. Its names and types are those of ROS,
but it tells no node. Commands: peer.py, without services. Runs among the packages of Jazzy, whose classes make its samples."""

import queue
import subprocess
import sys
import threading
from types import SimpleNamespace

import peer

ANSWERED_WITHIN = 20


def dds_name(name: str) -> str:
    """The name that ROS gives a type in DDS."""
    package, group, name = name.split("/")
    return f"{package}::{group}::dds_::{name}_"


class OwnNode:
    """A process with a participant. It knows an endpoint by its place in `ends`."""

    def __init__(self):
        self.process = subprocess.Popen(sys.argv[1:2], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.ends, self.answers, self.asking = [], queue.SimpleQueue(), threading.Lock()
        self.listener = threading.Thread(target=self.listen, daemon=True)
        self.listener.start()

    def listen(self) -> None:
        for line in self.process.stdout:
            match line.split():
                case [b"met", end, count]:
                    self.ends[int(end)].matched = int(count)
                case [b"got", end, size]:
                    self.ends[int(end)].log.add(self.process.stdout.read(int(size)))
                case _:
                    self.answers.put(line.decode().strip())
        self.answers.put("the program has ended")

    def ask(self, *words, data: bytes = b"") -> None:
        with self.asking:
            self.process.stdin.write(" ".join(map(str, words)).encode() + b"\n" + data)
            self.process.stdin.flush()
            answer = self.answers.get(timeout=ANSWERED_WITHIN)
        if answer != "done":
            raise RuntimeError(answer)

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()
        self.listener.join()


class FastDdsPeer(peer.Peer):
    def __init__(self):
        super().__init__()
        self.nodes = {}

    def close(self) -> None:
        for node in self.nodes.values():
            node.close()

    def op_node(self, node, namespace="/") -> dict:
        self.nodes[node] = OwnNode()
        return {}

    def end(self, kind, name, node, topic, type, qos) -> dict:
        own, qos = self.nodes[node], {**peer.QOS, **qos}
        number = len(own.ends)
        end = SimpleNamespace(node=node, number=number, type=type, log=peer.Log(), matched=0)
        end.publish = lambda data: own.ask("write", number, len(data), data=data)
        own.ends.append(end)
        own.ask(kind, number, f"rt{topic}", dds_name(type), *(int(qos[key]) for key in peer.QOS))
        self.ends[name] = end
        return {}

    def op_publisher(self, **given) -> dict:
        return self.end("writer", **given)

    def op_subscription(self, **given) -> dict:
        return self.end("reader", **given)

    def op_matched(self, name) -> dict:
        return {"count": self.ends[name].matched}

    def op_destroy(self, name) -> dict:
        if name in self.nodes:
            self.ends = {other: end for other, end in self.ends.items() if end.node != name}
            self.nodes.pop(name).close()
        else:
            end = self.ends.pop(name)
            self.nodes[end.node].ask("delete", end.number)
        return {}


if __name__ == "__main__":
    FastDdsPeer().run("fastdds")
