// Drives a blaze-config (BLAZE_SERVER, BLAZE_TOKEN) through openapi-fetch with the types that openapi-typescript makes of
// openapi.json.

import { deepStrictEqual as same, ok } from "node:assert/strict";

import createClient from "openapi-fetch";

import type { components, paths } from "./schema.js";

type Problem = components["schemas"]["Problem"];

const server = setting("BLAZE_SERVER");
const client = createClient<paths>({
  baseUrl: server,
  headers: { Authorization: `Bearer ${setting("BLAZE_TOKEN")}` },
});

await created();
await paged();
await replaced();
await patched();
await applied();
await remembered();
await deleted();
await refused();
console.error("typescript: the round trip is done");

function setting(name: string): string {
  const value = process.env[name];
  ok(value, `${name} is not set`);
  return value;
}

/** What was asked for, or the refusal as an error. */
function given<T>(answer: { data?: T; error?: Problem; response: Response }): T {
  ok(answer.data !== undefined, `${answer.response.status}: ${JSON.stringify(answer.error)}`);
  return answer.data;
}

/** The refusal that is expected. */
function problem(answer: { error?: Problem; response: Response }, status: number, code: string): Problem {
  ok(answer.error, `${answer.response.status} instead of ${status}`);
  same([answer.response.status, answer.error.status, answer.error.code], [status, status, code]);
  return answer.error;
}

async function created() {
  const answer = await client.POST("/api/v1/layers", {
    body: { name: "edge", labels: { site: "lab" }, spec: { kind: "edge", config: { log: { level: "info" } } } },
  });
  const layer = given(answer);
  same([layer.kind, layer.spec.kind, layer.labels["site"]], ["Layer", "edge", "lab"]);
  same(answer.response.status, 201);
  same(answer.response.headers.get("etag"), `"${layer.revision}"`);
  same(answer.response.headers.get("location"), "/api/v1/layers/edge");

  for (const name of ["robot-1", "robot-2", "robot-3"]) {
    const request = {
      params: { header: { "Idempotency-Key": `make-${name}` } },
      body: { name, spec: { layer: "edge", type: "mobile" as const, addresses: ["10.0.1.7"] } },
    };
    const node = given(await client.POST("/api/v1/nodes", request));
    const again = await client.POST("/api/v1/nodes", request);
    same(given(again), node);
    same(again.response.headers.get("idempotent-replayed"), "true");
  }
  given(
    await client.POST("/api/v1/services", {
      body: { name: "slam", spec: { config: { camera: { rate_hz: 30 } }, schema: { type: "object" } } },
    }),
  );
}

async function paged() {
  const names: string[] = [];
  let token = "";
  do {
    const page = given(await client.GET("/api/v1/nodes", { params: { query: { limit: 2, page_token: token } } }));
    ok(page.items.length <= 2);
    names.push(...page.items.map((node) => node.name));
    token = page.next_page_token;
  } while (token);
  same(names, ["robot-1", "robot-2", "robot-3"]);
}

async function replaced() {
  const path = { name: "robot-1" };
  const got = await client.GET("/api/v1/nodes/{name}", { params: { path } });
  const node = given(got);
  same([node.spec.type, node.spec.addresses], ["mobile", ["10.0.1.7"]]);
  const etag = got.response.headers.get("etag");
  ok(etag);

  const request = {
    params: { path, header: { "If-Match": etag } },
    body: { spec: { layer: "edge", type: "static" as const } },
  };
  const now = given(await client.PUT("/api/v1/nodes/{name}", request));
  ok(now.revision > node.revision);
  same([now.uid, now.create_time], [node.uid, node.create_time]);

  const stale = problem(await client.PUT("/api/v1/nodes/{name}", request), 412, "precondition_failed");
  same([stale.revision, stale.type], [now.revision, "/docs/errors/precondition_failed"]);
  ok(stale.request_id);
}

async function patched() {
  const service = given(
    await client.PATCH("/api/v1/services/{name}", {
      params: { path: { name: "slam" }, header: { "If-Match": "*" } },
      headers: { "Content-Type": "application/merge-patch+json" },
      body: { labels: { site: "lab" }, spec: { config: { camera: { rate_hz: 20 } } } },
    }),
  );
  same(service.spec.config, { camera: { rate_hz: 20 } });
  same(service.labels, { site: "lab" });
}

async function applied() {
  const body: components["schemas"]["ApplyItem"][] = [
    { kind: "Instance", service: "slam", name: "0", spec: { node: "robot-1", config: { camera: { rate_hz: 10 } } } },
    { kind: "Layer", name: "fog", spec: { kind: "fog" } },
  ];
  const dry = given(await client.POST("/api/v1/apply", { params: { query: { dry_run: true } }, body }));
  ok(dry.dry_run);
  const report = given(await client.POST("/api/v1/apply", { body }));
  same(report.revision, dry.revision + 1);
  same(report.results.map((result) => result.action), ["created", "created"]);
  same(report.affected.map((place) => [place.service, place.instance]), [["slam", "0"]]);

  const query = { service: "slam", instance: "0", explain: true };
  const effective = given(await client.GET("/api/v1/effective", { params: { query } }));
  same([effective.layer, effective.node], ["edge", "robot-1"]);
  same(effective.config, { log: { level: "info" }, camera: { rate_hz: 10 } });
  const source = effective.explain?.["/camera/rate_hz"];
  same([source?.kind, source?.overridden?.[0]?.value], ["Instance", 20]);
}

async function remembered() {
  const history = given(
    await client.GET("/api/v1/nodes/{name}/history", { params: { path: { name: "robot-1" } } }),
  );
  same(history.items.map((entry) => entry.op), ["update", "create"]);
  ok(history.items[0]?.paths.includes("/spec/type"));
}

async function deleted() {
  const path = { name: "robot-2" };
  const blind = problem(
    await client.DELETE("/api/v1/nodes/{name}", { params: { path } }),
    428,
    "precondition_required",
  );
  const header = { "If-Match": `"${blind.revision}"` };
  const gone = await client.DELETE("/api/v1/nodes/{name}", { params: { path, header } });
  same(gone.response.status, 204);
  problem(await client.GET("/api/v1/nodes/{name}", { params: { path } }), 404, "not_found");
  const used = { path: { name: "robot-1" }, header: { "If-Match": "*" } };
  problem(await client.DELETE("/api/v1/nodes/{name}", { params: used }), 409, "in_use");
}

async function refused() {
  const stranger = createClient<paths>({ baseUrl: server, headers: { Authorization: "Bearer not-a-token" } });
  problem(await stranger.GET("/api/v1/nodes"), 401, "unauthenticated");
}
