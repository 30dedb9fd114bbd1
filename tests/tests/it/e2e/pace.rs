//! The pacer keeps the budget on the wire, as the interface counts it, and the IMU loses nothing beside the camera.

use std::time::Duration;

use blaze_tests::network::{Meter, Pair, Sample, check_rights};
use blaze_tests::{long, wait};

use super::support::{Launch, Node, count};

const DOMAIN: u16 = 66;
const LIMIT_MBPS: f64 = 40.0;
const CAMERA: &str = "camera/image_raw";

fn limit_bytes() -> f64 {
    LIMIT_MBPS * 1024.0 * 1024.0 / 8.0
}

/// Begin (seconds after the first sample), length (a second and at most one period of the samples more) and bytes of the
/// busiest second that begins at a sample.
struct Second {
    begin_s: f64,
    length_s: f64,
    bytes: f64,
}

impl Second {
    fn rate(&self) -> f64 {
        self.bytes / self.length_s
    }
}

fn busiest_second(samples: &[Sample]) -> Option<Second> {
    let start = samples.first()?.at_s;
    let windows = samples.iter().enumerate().filter_map(|(index, first)| {
        let last = samples[index..].iter().find(|last| last.at_s - first.at_s >= 1.0)?;
        Some(Second {
            begin_s: first.at_s - start,
            length_s: last.at_s - first.at_s,
            bytes: (last.bytes - first.bytes) as f64,
        })
    });
    windows.max_by(|a, b| a.rate().total_cmp(&b.rate()))
}

fn tails(nodes: [&Node; 2]) -> String {
    nodes
        .map(|node| format!("--- {}\n{}", node.name, node.process.tail()))
        .join("\n")
}

fn camera_within_the_budget() -> anyhow::Result<()> {
    check_rights()?;
    let pair = Pair::new()?;
    let launch = |node, host: usize| Launch {
        listen: pair.addresses[host].clone(),
        // One seed on one side.
        peer: (host == 0).then(|| pair.addresses[1].clone()),
        namespace: Some(pair.names[host].clone()),
        light: false,
        settings: vec![format!("flow.bandwidth.limit_mbps={LIMIT_MBPS}")],
        ..Launch::local(node, DOMAIN)
    };
    // The counter runs from before the start: discovery counts, too.
    let meter = Meter::start(&pair.names[0], 20)?;
    let mut cloud = launch("cloud-1", 1).start()?;
    let mut robot = launch("robot-1", 0).start()?;
    cloud.ready()?;
    robot.ready()?;
    let seen = || cloud.bridged("camera/image_raw|inter>layer|cloud") > 0;
    wait::until("pictures in the cloud", Duration::from_secs(10), seen, || {
        tails([&robot, &cloud])
    })?;

    let seconds = if long() { 60 } else { 15 };
    let (before, computed_before) = (pair.sent(0)?.0, robot.wire_bytes());
    std::thread::sleep(Duration::from_secs(seconds));
    let (counted, computed) = (pair.sent(0)?.0 - before, robot.wire_bytes() - computed_before);

    let samples = meter.samples();
    drop(meter);
    let busiest = busiest_second(&samples).ok_or_else(|| anyhow::anyhow!("too few samples"))?;
    let span = samples.last().map_or(0.0, |s| s.at_s) - samples.first().map_or(0.0, |s| s.at_s);
    let limit = limit_bytes();
    println!(
        "pace: {} samples in {span:.1} s; busiest second {:.0} B/s ({:.3} s from {:.1} s on), limit {limit:.0} B/s: {:.2} %",
        samples.len(),
        busiest.rate(),
        busiest.length_s,
        busiest.begin_s,
        100.0 * busiest.rate() / limit
    );
    let ratio = computed as f64 / counted as f64;
    println!("pace: over {seconds} s the interface counted {counted} B, the flow computed {computed} B ({ratio:.4})");
    let cloud_end = cloud.end()?;
    let robot_end = robot.end()?;
    let (imu, camera) = (
        cloud_end.topic("imu/data", "recorder")?,
        cloud_end.topic(CAMERA, "recorder")?,
    );
    println!("pace: imu {imu}");
    println!(
        "pace: camera {camera}; {} pictures were published",
        robot_end.sent(CAMERA)
    );

    let judge = || {
        anyhow::ensure!(
            samples.len() > 300 && span > 10.0,
            "{} samples in {span:.1} s",
            samples.len()
        );
        anyhow::ensure!(
            counted as f64 > 0.6 * limit * seconds as f64,
            "the camera does not fill the budget"
        );
        anyhow::ensure!(busiest.rate() <= limit, "a second exceeds the limit");
        anyhow::ensure!(
            (0.97..=1.03).contains(&ratio),
            "computed and counted bytes differ: {ratio:.4}"
        );
        anyhow::ensure!(count(imu, "received") > 500, "too few IMU messages");
        for fault in ["lost", "duplicated", "reordered"] {
            anyhow::ensure!(count(imu, fault) == 0, "IMU: {fault}: {imu}");
        }
        anyhow::ensure!(
            count(camera, "received") > 0 && count(camera, "duplicated") == 0,
            "{camera}"
        );
        Ok(())
    };
    judge().map_err(|error| error.context(tails([&robot, &cloud])))
}

#[test]
fn the_camera_stays_within_the_budget_and_the_imu_is_whole() {
    camera_within_the_budget().unwrap_or_else(|error| panic!("{error:#}"));
}
