//! Full counts.

use std::time::Duration;

use blaze_tests::ros2::Release;

use super::support::{ARRIVE, MEET, Pair};
use super::{churn, quality, routes, services};

#[test]
fn every_release_reaches_every_other() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    for from in Release::ALL {
        for to in Release::ALL {
            routes::carry(&pair, from, to, &routes::TOPICS)?;
        }
    }
    Ok(())
}

#[test]
fn qualities_of_cyclone_flow_or_are_named() -> anyhow::Result<()> {
    quality::compare(Release::Cyclone, Release::Jazzy)?;
    quality::compare(Release::Kilted, Release::Cyclone)
}

#[test]
fn a_node_restarts_fifty_times() -> anyhow::Result<()> {
    churn::restart(50, true)
}

#[test]
fn two_thousand_subscriptions_come_and_go() -> anyhow::Result<()> {
    churn::subscribe(2_000)
}

#[test]
fn ten_thousand_calls_of_sixteen_clients_for_each_pair_of_releases() -> anyhow::Result<()> {
    use Release::{Cyclone, Jazzy, Kilted};
    let pair = Pair::start()?;
    for (from, to) in [(Kilted, Jazzy), (Cyclone, Cyclone), (Jazzy, Cyclone), (Cyclone, Kilted)] {
        let (caller, called) = (pair.in_cloud(from)?, pair.on_robot(to)?);
        let service = format!("/{from:?}_{to:?}").to_lowercase();
        let server = services::server(&called, &service)?;
        let clients = services::clients(&caller, &service, 16)?;
        for client in &clients {
            client.wait_available(true, MEET)?;
        }
        let start = std::time::Instant::now();
        services::call_all(&pair, &[(&caller, clients)], 625, ARRIVE * 20)?;
        println!("10,000 calls from {from:?} to {to:?} in {:?}", start.elapsed());
        assert_eq!(server.served()?, 10_000);
        services::wait_answered(&pair)?;
        caller.finish()?;
        called.finish()?;
    }
    Ok(())
}

#[test]
fn the_server_of_a_node_that_was_killed_is_seen_until_dds_gives_it_up() -> anyhow::Result<()> {
    /// The lease of rclpy, and what the flows take.
    const GIVEN_UP: Duration = Duration::from_secs(23);
    let pair = Pair::start()?;
    let (caller, called) = (pair.in_cloud(Release::Kilted)?, pair.on_robot(Release::Jazzy)?);
    services::server(&called, "/killed")?;
    let clients = services::clients(&caller, "/killed", 1)?;
    clients[0].wait_available(true, MEET)?;
    drop(called);
    let took = clients[0].wait_available(false, GIVEN_UP)?;
    println!("seen no longer {took:?} after it was killed");
    Ok(())
}

#[test]
fn an_action_has_its_result_after_ten_minutes() -> anyhow::Result<()> {
    services::act(60, Duration::from_secs(10))
}
