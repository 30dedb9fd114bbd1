"""A ROS 2 peer of the tests with rclpy and Fast DDS. Commands: peer.py."""

import gc
import threading
import time
from types import SimpleNamespace

import peer
import rclpy
import tf_message
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from test_msgs.action import Fibonacci

# Numbers of a Fibonacci sequence stay below it, however long that is.
LARGEST = 2**31


def profile(given: dict) -> QoSProfile:
    given = {**peer.QOS, **given}
    times = {"deadline": "deadline_ms", "liveliness_lease_duration": "lease_ms", "lifespan": "lifespan_ms"}
    return QoSProfile(
        depth=given["depth"],
        reliability=ReliabilityPolicy.RELIABLE if given["reliable"] else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if given["durable"] else DurabilityPolicy.VOLATILE,
        **{name: Duration(nanoseconds=given[key] * 1_000_000) for name, key in times.items() if given[key]},
    )


def message_class(name: str) -> type:
    return tf_message.message_class() if name == tf_message.NAME else peer.found(name)


class OwnNode:
    """A node with a participant and a thread of its own."""

    def __init__(self, name: str, namespace: str):
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node(name, namespace=namespace, context=self.context)
        self.executor = MultiThreadedExecutor(2, context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.spin, daemon=True)
        self.thread.start()

    def spin(self) -> None:
        try:
            self.executor.spin()
        except ExternalShutdownException:
            pass

    def close(self) -> None:
        self.executor.shutdown()
        self.thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        # The participant ends with the last reference to its context.
        del self.executor, self.node, self.context
        gc.collect()


class Ros2Peer(peer.Peer):
    def __init__(self):
        super().__init__()
        self.nodes = {}

    def close(self) -> None:
        for node in list(self.nodes):
            self.op_destroy(node)

    def op_node(self, node, namespace="/") -> dict:
        self.nodes[node] = OwnNode(node, namespace)
        return {}

    def end(self, name, node, kind, **parts):
        self.ends[name] = SimpleNamespace(node=node, log=peer.Log(), destroy=None, count=0, type=kind, **parts)
        return self.ends[name], self.nodes[node].node

    def op_publisher(self, name, node, topic, type, qos) -> dict:
        end, node = self.end(name, node, type)
        publisher = node.create_publisher(message_class(type), topic, profile(qos))
        end.publish, end.matched = publisher.publish, publisher.get_subscription_count
        end.destroy = lambda: node.destroy_publisher(publisher)
        return {}

    def op_subscription(self, name, node, topic, type, qos) -> dict:
        end, node = self.end(name, node, type)
        subscription = node.create_subscription(message_class(type), topic, end.log.add, profile(qos), raw=True)
        end.matched = subscription.get_publisher_count
        end.destroy = lambda: node.destroy_subscription(subscription)
        return {}

    def op_matched(self, name) -> dict:
        return {"count": self.ends[name].matched()}

    def op_destroy(self, name) -> dict:
        if name in self.nodes:
            self.ends = {other: end for other, end in self.ends.items() if end.node != name}
            self.nodes.pop(name).close()
        else:
            self.ends.pop(name).destroy()
        return {}

    # --- services and actions ---

    def op_server(self, name, node, service, type, reply=None, delay_ms=0) -> dict:
        end, node = self.end(name, node, type)

        def serve(request, response):
            end.count += 1
            time.sleep(delay_ms / 1e3)
            return peer.with_fields(peer.echo(request, response), reply or {})

        server = node.create_service(peer.found(type), service, serve)
        end.destroy = lambda: node.destroy_service(server)
        return {}

    def op_client(self, name, node, service, type) -> dict:
        end, node = self.end(name, node, type)
        # Each client gets the replies to all of its node, and by default keeps ten of them.
        kept = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
        end.client = node.create_client(peer.found(type), service, qos_profile=kept)
        end.available = end.client.service_is_ready
        end.destroy = lambda: node.destroy_client(end.client)
        return {}

    def op_available(self, name) -> dict:
        return {"ready": self.ends[name].available()}

    def op_call(self, name, request, timeout_ms) -> dict:
        end = self.ends[name]
        future = end.client.call_async(peer.with_fields(peer.found(end.type).Request(), request))
        return {"reply": peer.fields_of(result(future, time.monotonic() + timeout_ms / 1e3))}

    def op_served(self, name) -> dict:
        return {"count": self.ends[name].count}

    def op_action_server(self, name, node, action, step_ms=10) -> dict:
        end, node = self.end(name, node, "test_msgs/action/Fibonacci")

        def execute(goal):
            end.count += 1
            sequence = [0, 1]
            for _ in range(goal.request.order):
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Fibonacci.Result()
                sequence.append((sequence[-1] + sequence[-2]) % LARGEST)
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
                time.sleep(step_ms / 1e3)
            goal.succeed()
            return Fibonacci.Result(sequence=sequence)

        server = ActionServer(
            node, Fibonacci, action, execute, callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )  # fmt: skip
        end.destroy = server.destroy
        return {}

    def op_action_client(self, name, node, action) -> dict:
        end, node = self.end(name, node, "test_msgs/action/Fibonacci")
        end.client = ActionClient(node, Fibonacci, action)
        end.available, end.destroy = end.client.server_is_ready, end.client.destroy
        return {}

    def op_goal(self, name, order, timeout_ms) -> dict:
        end, feedback, deadline = self.ends[name], [], time.monotonic() + timeout_ms / 1e3
        goal = self.begin(end, order, lambda told: feedback.append(list(told.feedback.sequence)), deadline)
        done = result(goal.get_result_async(), deadline)
        return {"status": done.status, "feedback": feedback, "sequence": list(done.result.sequence)}

    def op_cancel(self, name, order, timeout_ms) -> dict:
        end, began, deadline = self.ends[name], threading.Event(), time.monotonic() + timeout_ms / 1e3
        goal = self.begin(end, order, lambda _: began.set(), deadline)
        if not began.wait(deadline - time.monotonic()):
            raise TimeoutError("no feedback")
        result(goal.cancel_goal_async(), deadline)
        return {"status": result(goal.get_result_async(), deadline).status}

    @staticmethod
    def begin(end, order: int, feedback, deadline: float):
        goal = result(end.client.send_goal_async(Fibonacci.Goal(order=order), feedback_callback=feedback), deadline)
        if not goal.accepted:
            raise RuntimeError("the goal was rejected")
        return goal

    # --- the graph ---

    def op_topics(self, node) -> dict:
        return {"topics": dict(self.nodes[node].node.get_topic_names_and_types())}

    def op_services(self, node) -> dict:
        return {"services": dict(self.nodes[node].node.get_service_names_and_types())}

    def op_nodes(self, node) -> dict:
        found = self.nodes[node].node.get_node_names_and_namespaces()
        return {"nodes": sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in found)}

    def op_endpoints(self, node, topic) -> dict:
        node = self.nodes[node].node
        return {
            "publishers": [endpoint(each) for each in node.get_publishers_info_by_topic(topic)],
            "subscriptions": [endpoint(each) for each in node.get_subscriptions_info_by_topic(topic)],
        }


def endpoint(found) -> dict:
    return {
        "node": f"{found.node_namespace.rstrip('/')}/{found.node_name}",
        "type": found.topic_type,
        "hash": str(found.topic_type_hash),
        "gid": bytes(found.endpoint_gid).hex(),
        "reliable": found.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
        "durable": found.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
    }


def result(future, deadline: float):
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    if not done.wait(max(0, deadline - time.monotonic())):
        raise TimeoutError("no answer")
    return future.result()


if __name__ == "__main__":
    Ros2Peer().run(rclpy.get_rmw_implementation_identifier())
