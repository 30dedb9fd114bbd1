//! Services and actions between layers: every reply to its caller, and a server shows elsewhere as
//! long as it lives.

use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::ros2::{End, Peer, Release};
use blaze_tests::{wait, within};
use serde_json::{Value, json};

use super::support::{ARRIVE, MEET, NODE, Pair};

const KIND: &str = "test_msgs/srv/BasicTypes";
const FIELD: &str = "int64_value";
/// For the end of a server to get from one network to the other.
const FOLLOWS: Duration = Duration::from_secs(3);

pub(super) fn server<'a>(peer: &'a Peer, service: &str) -> anyhow::Result<End<'a>> {
    peer.end(json!({ "op": "server", "node": NODE, "service": service, "type": KIND }))
}

pub(super) fn clients<'a>(
    peer: &'a Peer,
    service: &str,
    count: usize,
) -> anyhow::Result<Vec<End<'a>>> {
    let client = json!({ "op": "client", "node": NODE, "service": service, "type": KIND });
    (0..count).map(|_| peer.end(client.clone())).collect()
}

/// Lets all clients of some peers call at once, each so many times; all get their own replies.
pub(super) fn call_all(
    pair: &Pair,
    callers: &[(&Peer, Vec<End<'_>>)],
    count: usize,
    deadline: Duration,
) -> anyhow::Result<()> {
    std::thread::scope(|scope| {
        let begin = |(peer, clients): &(&Peer, Vec<End<'_>>)| {
            let (peer, clients): (&Peer, &[End<'_>]) = (peer, clients);
            (peer.release, clients.len() * count, peer.call_all(clients, FIELD, count, deadline))
        };
        let running = callers.iter().map(|caller| scope.spawn(move || begin(caller)));
        for caller in running.collect::<Vec<_>>() {
            let (release, expected, outcome) = caller.join().expect("no panic");
            let (answered, faults) = outcome?;
            anyhow::ensure!(
                answered == expected && faults.is_empty(),
                "{answered} of {expected} calls of {release:?}: {faults:#?}\n{}",
                pair.state("fast/_request")
            );
        }
        Ok(())
    })
}

/// Waits until no request waits for its reply.
pub(super) fn wait_answered(pair: &Pair) -> anyhow::Result<()> {
    let pending = || -> anyhow::Result<Value> {
        let of = |flow: &blaze_tests::flow::FlowProcess| flow.admin().json("/v1/ros2");
        Ok(json!([of(&pair.edge)?["calls"]["pending"], of(&pair.cloud)?["calls"]["pending"]]))
    };
    let none = || pending().is_ok_and(|pending| pending == json!([0, 0]));
    wait::until("no request waits", ARRIVE, none, || format!("{:?}", pending()))?;
    Ok(())
}

/// Waits until a peer sees a service, or no longer.
fn wait_listed(peer: &Peer, service: &str, listed: bool) -> anyhow::Result<Duration> {
    let asked = || peer.ask(&json!({ "op": "services", "node": NODE })).unwrap_or_default();
    let is_so = || {
        let types = &asked()["services"][service];
        if listed { *types == json!([KIND]) } else { types.is_null() }
    };
    wait::until(&format!("{service} is listed: {listed}"), MEET, is_so, || asked().to_string())
}

#[test]
fn every_reply_reaches_its_caller_whatever_dds_it_uses() -> anyhow::Result<()> {
    const CLIENTS: usize = 4;
    const CALLS: usize = 25;
    let mut pair = Pair::start()?;
    let (fast, cyclone) = (pair.on_robot(Release::Jazzy)?, pair.on_robot(Release::Cyclone)?);
    let servers = [server(&fast, "/fast")?, server(&cyclone, "/cyclone")?];
    let cloud = [pair.in_cloud(Release::Kilted)?, pair.in_cloud(Release::Cyclone)?];
    for service in ["/fast", "/cyclone"] {
        wait_listed(&cloud[0], service, true).context("before there is a client")?;
    }
    let mut callers = Vec::new();
    for peer in &cloud {
        let mut all = clients(peer, "/fast", CLIENTS)?;
        all.extend(clients(peer, "/cyclone", CLIENTS)?);
        callers.push((peer, all));
    }
    for client in callers.iter().flat_map(|(_, clients)| clients) {
        client.wait_available(true, MEET)?;
    }
    // The first calls of all clients come at once.
    call_all(&pair, &callers, CALLS, ARRIVE * 2)?;
    let calls = 2 * CLIENTS * CALLS;
    let served = [servers[0].served()?, servers[1].served()?];
    assert_eq!(served, [calls as u64; 2], "each request once");
    wait_answered(&pair)?;

    let [fast_server, _cyclone_server] = servers;
    fast_server.destroy()?;
    let [of_kilted, of_cyclone] = [&callers[0].1, &callers[1].1];
    for clients in [of_kilted, of_cyclone] {
        let took = clients[0].wait_available(false, within(FOLLOWS))?;
        println!("the server that ended is seen no longer after {took:?}");
        assert!(clients[CLIENTS].available()?, "the other one stays");
    }
    pair.edge.kill()?;
    for clients in [of_kilted, of_cyclone] {
        let took = clients[CLIENTS].wait_available(false, within(FOLLOWS))?;
        println!("the server of a flow that was killed is seen no longer after {took:?}");
    }
    Ok(())
}

/// Runs a goal of an action, with so much time between its steps, and cancels another one.
pub(super) fn act(steps: u64, step: Duration) -> anyhow::Result<()> {
    const SUCCEEDED: i64 = 4;
    const CANCELED: i64 = 5;
    let pair = Pair::start()?;
    let (robot, cloud) = (pair.on_robot(Release::Kilted)?, pair.in_cloud(Release::Jazzy)?);
    let mut server = json!({ "op": "action_server", "node": NODE, "action": "/fib" });
    server["step_ms"] = json!(u64::try_from(step.as_millis())?);
    let server = cloud.end(server)?;
    let client = robot.end(json!({ "op": "action_client", "node": NODE, "action": "/fib" }))?;
    client.wait_available(true, MEET)?;
    let limit = ARRIVE + step * u32::try_from(steps)?;
    let ask = |op: &str, steps: u64| {
        let timeout = u64::try_from(limit.as_millis())?;
        let command = json!({ "op": op, "order": steps, "timeout_ms": timeout });
        client.ask_within(command, limit + ARRIVE).with_context(|| pair.state("fib/_action/status"))
    };
    let done = ask("goal", steps)?;
    assert_eq!(done["status"], SUCCEEDED);
    assert_eq!(done["sequence"].as_array().map(Vec::len), Some(usize::try_from(steps)? + 2));
    let feedback = done["feedback"].as_array().context("no feedback")?;
    assert_eq!(feedback.last(), Some(&done["sequence"]), "{} of {steps}", feedback.len());
    assert_eq!(ask("cancel", 100_000)?["status"], CANCELED);
    assert_eq!(server.served()?, 2);
    wait_answered(&pair)?;
    server.destroy()?;
    client.wait_available(false, within(FOLLOWS))?;
    Ok(())
}

#[test]
fn an_action_of_another_layer_gives_feedback_and_results_and_is_cancelled() -> anyhow::Result<()> {
    act(50, Duration::from_millis(10))
}
