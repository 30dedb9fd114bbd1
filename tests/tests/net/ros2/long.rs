//! Full counts.

use blaze_tests::ros2::Release;

use super::support::Pair;
use super::{churn, quality, routes};

#[test]
fn every_release_reaches_every_other() -> anyhow::Result<()> {
    let pair = Pair::start()?;
    for from in Release::ALL {
        for to in Release::ALL {
            routes::carry(&pair, from, to)?;
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
    churn::restart(50)
}

#[test]
fn two_thousand_subscriptions_come_and_go() -> anyhow::Result<()> {
    churn::subscribe(2_000)
}
