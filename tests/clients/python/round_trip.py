"""Drives a blaze-config (BLAZE_SERVER, BLAZE_TOKEN) through the client that openapi-python-client makes of openapi.json."""

import importlib
import json
import os
import pkgutil
import sys

import blaze_config_client
from blaze_config_client import AuthenticatedClient
from blaze_config_client.api.configuration import apply, get_effective
from blaze_config_client.api.layers import create_layer
from blaze_config_client.api.nodes import (
    create_node,
    delete_node,
    get_node,
    list_node_history,
    list_nodes,
    replace_node,
)
from blaze_config_client.api.services import create_service, patch_service
from blaze_config_client.models import (
    ApplyItem,
    ApplyReport,
    ApplyResultAction,
    DocumentPatch,
    Effective,
    HistoryEntryOp,
    HistoryPage,
    Layer,
    LayerInput,
    LayerSpecKind,
    Node,
    NodeInput,
    NodePage,
    NodeSpecType,
    Problem,
    Service,
    ServiceInput,
)


def main() -> None:
    everything_is_there()
    client = AuthenticatedClient(os.environ["BLAZE_SERVER"], os.environ["BLAZE_TOKEN"], raise_on_unexpected_status=True)
    created(client)
    paged(client)
    replaced(client)
    patched(client)
    applied(client)
    remembered(client)
    deleted(client)
    refused()


def everything_is_there() -> None:
    """Each operation of the document is a module, and each module can be loaded."""
    with open(os.environ["BLAZE_OPENAPI"]) as file:
        paths = json.load(file)["paths"]
    operations = {operation["operationId"] for item in paths.values() for operation in item.values()}
    modules = [module.name for module in pkgutil.walk_packages(blaze_config_client.__path__, "blaze_config_client.")]
    for module in modules:
        importlib.import_module(module)
    missing = operations - {module.rsplit(".", 1)[1] for module in modules if ".api." in module}
    assert not missing, f"not in the client: {sorted(missing)}"


def created(client: AuthenticatedClient) -> None:
    edge = {"name": "edge", "labels": {"site": "lab"}, "spec": {"kind": "edge", "config": {"log": {"level": "info"}}}}
    answer = create_layer.sync_detailed(client=client, body=LayerInput.from_dict(edge))
    assert answer.status_code == 201, answer
    layer = answer.parsed
    assert isinstance(layer, Layer) and layer.spec.kind is LayerSpecKind.EDGE and layer.labels["site"] == "lab", layer
    assert answer.headers["etag"] == f'"{layer.revision}"' and answer.headers["location"] == "/api/v1/layers/edge"
    for name in ("robot-1", "robot-2", "robot-3"):
        node = {"name": name, "spec": {"layer": "edge", "type": "mobile", "addresses": ["10.0.1.7"]}}
        answer = create_node.sync_detailed(client=client, body=NodeInput.from_dict(node), idempotency_key=f"make-{name}")
        assert answer.status_code == 201, answer
    again = create_node.sync_detailed(client=client, body=NodeInput.from_dict(node), idempotency_key=f"make-{name}")
    assert again.status_code == 201 and again.headers["idempotent-replayed"] == "true" and again.parsed == answer.parsed
    slam = {"name": "slam", "spec": {"config": {"camera": {"rate_hz": 30}}, "schema": {"type": "object"}}}
    answer = create_service.sync_detailed(client=client, body=ServiceInput.from_dict(slam))
    assert answer.status_code == 201 and isinstance(answer.parsed, Service), answer


def paged(client: AuthenticatedClient) -> None:
    first = list_nodes.sync(client=client, limit=2)
    assert isinstance(first, NodePage) and first.next_page_token, first
    second = list_nodes.sync(client=client, limit=2, page_token=first.next_page_token)
    assert isinstance(second, NodePage) and not second.next_page_token and second.revision == first.revision, second
    assert [node.name for node in first.items + second.items] == ["robot-1", "robot-2", "robot-3"]


def replaced(client: AuthenticatedClient) -> None:
    got = get_node.sync_detailed("robot-1", client=client)
    node = got.parsed
    assert isinstance(node, Node) and node.spec.type_ is NodeSpecType.MOBILE and node.spec.addresses == ["10.0.1.7"]
    etag = got.headers["etag"]
    body = NodeInput.from_dict({"spec": {"layer": "edge", "type": "static"}})
    now = replace_node.sync_detailed("robot-1", client=client, body=body, if_match=etag)
    assert now.status_code == 200 and isinstance(now.parsed, Node) and now.parsed.revision > node.revision, now
    assert now.parsed.uid == node.uid and now.parsed.create_time == node.create_time
    stale = replace_node.sync_detailed("robot-1", client=client, body=body, if_match=etag)
    problem = stale.parsed
    assert stale.status_code == 412 and isinstance(problem, Problem), stale
    assert problem.code == "precondition_failed" and problem.revision == now.parsed.revision, problem
    assert problem.type_ == "/docs/errors/precondition_failed" and problem.request_id, problem


def patched(client: AuthenticatedClient) -> None:
    patch = DocumentPatch.from_dict({"labels": {"site": "lab"}, "spec": {"config": {"camera": {"rate_hz": 20}}}})
    service = patch_service.sync("slam", client=client, body=patch, if_match="*")
    assert isinstance(service, Service) and service.spec.config["camera"] == {"rate_hz": 20}, service
    assert service.labels["site"] == "lab", service


def applied(client: AuthenticatedClient) -> None:
    instance = {"kind": "Instance", "service": "slam", "name": "0"}
    instance["spec"] = {"node": "robot-1", "config": {"camera": {"rate_hz": 10}}}
    fog = {"kind": "Layer", "name": "fog", "spec": {"kind": "fog"}}
    items = [ApplyItem.from_dict(instance), ApplyItem.from_dict(fog)]
    dry = apply.sync(client=client, body=items, dry_run=True)
    assert isinstance(dry, ApplyReport) and dry.dry_run, dry
    report = apply.sync(client=client, body=items)
    assert isinstance(report, ApplyReport) and report.revision == dry.revision + 1, report
    assert [result.action for result in report.results] == [ApplyResultAction.CREATED, ApplyResultAction.CREATED], report
    assert [(place.service, place.instance) for place in report.affected] == [("slam", "0")], report
    effective = get_effective.sync(client=client, service="slam", instance="0", explain=True)
    assert isinstance(effective, Effective) and effective.node == "robot-1" and effective.layer == "edge", effective
    assert effective.config.to_dict() == {"camera": {"rate_hz": 10}, "log": {"level": "info"}}, effective
    source = effective.explain["/camera/rate_hz"]
    assert source.kind == "Instance" and source.overridden[0].to_dict()["value"] == 20, source


def remembered(client: AuthenticatedClient) -> None:
    history = list_node_history.sync("robot-1", client=client)
    assert isinstance(history, HistoryPage), history
    assert [entry.op for entry in history.items] == [HistoryEntryOp.UPDATE, HistoryEntryOp.CREATE], history
    assert "/spec/type" in history.items[0].paths, history


def deleted(client: AuthenticatedClient) -> None:
    blind = delete_node.sync_detailed("robot-2", client=client)
    assert blind.status_code == 428 and isinstance(blind.parsed, Problem), blind
    etag = f'"{blind.parsed.revision}"'
    gone = delete_node.sync_detailed("robot-2", client=client, if_match=etag)
    assert gone.status_code == 204 and gone.parsed is None, gone
    missing = get_node.sync("robot-2", client=client)
    assert isinstance(missing, Problem) and missing.code == "not_found", missing
    in_use = delete_node.sync("robot-1", client=client, if_match="*")
    assert isinstance(in_use, Problem) and in_use.code == "in_use", in_use


def refused() -> None:
    stranger = AuthenticatedClient(os.environ["BLAZE_SERVER"], "not-a-token")
    answer = list_nodes.sync_detailed(client=stranger)
    assert answer.status_code == 401 and isinstance(answer.parsed, Problem), answer
    assert answer.parsed.code == "unauthenticated", answer


if __name__ == "__main__":
    main()
    print("python: the round trip is done", file=sys.stderr)
