//! Time of both conversions for some types: `cargo run --release -p blaze-convert --example speed`.

#![allow(clippy::expect_used, reason = "a measurement stops where it cannot go on")]

use std::time::{Duration, Instant};

use blaze_convert::{Distro, Program, built_in};

const TIME: Duration = Duration::from_secs(1);

/// Repeats what is measured for a while. Mean time of one.
fn time(mut run: impl FnMut()) -> Duration {
    let start = Instant::now();
    let mut count = 0;
    while start.elapsed() < TIME {
        run();
        count += 1;
    }
    start.elapsed() / count
}

fn measure(name: &str, json: &str) {
    let description = built_in(Distro::Jazzy).describe(name).expect("it is built in");
    let compiling = time(|| drop(Program::compile(&description)));
    let program = Program::compile(&description).expect("it can be converted");
    let (mut cdr, mut text) = (Vec::new(), Vec::new());
    program.to_cdr(json.as_bytes(), &mut cdr).expect("a message");
    let to_json = time(|| {
        text.clear();
        program.to_json(&cdr, &mut text).expect("a message");
    });
    let to_cdr = time(|| {
        cdr.clear();
        program.to_cdr(&text, &mut cdr).expect("a message");
    });
    println!(
        "{name}: {} bytes of CDR, {} of JSON; compiled in {compiling:?}, to JSON {to_json:?}, \
         to CDR {to_cdr:?}",
        cdr.len(),
        text.len()
    );
}

fn main() {
    let covariance: Vec<String> =
        (0..36).map(|at| format!("{}", f64::from(at) * 0.01237 + 1e-9)).collect();
    let covariance = covariance.join(",");
    measure(
        "nav_msgs/msg/Odometry",
        &format!(
            r#"{{"header":{{"stamp":{{"sec":1764325012,"nanosec":123456789}},"frame_id":"odom"}},
            "child_frame_id":"base_link",
            "pose":{{"pose":{{"position":{{"x":12.3456789,"y":-0.98765,"z":0.1}},
            "orientation":{{"x":0.0012,"y":-0.0034,"z":0.70710678,"w":0.70710678}}}},
            "covariance":[{covariance}]}},
            "twist":{{"twist":{{"linear":{{"x":0.45678,"y":0,"z":0}},
            "angular":{{"x":0,"y":0,"z":0.1234567}}}},"covariance":[{covariance}]}}}}"#
        ),
    );
    let zeros = vec!["0.1"; 640].join(",");
    measure(
        "sensor_msgs/msg/LaserScan",
        &format!(r#"{{"ranges":[{zeros}],"intensities":[{zeros}]}}"#),
    );
    measure("geometry_msgs/msg/Twist", r#"{"linear":{"x":0.5},"angular":{"z":-0.25}}"#);
    let pixels = vec!["7"; 921_600].join(",");
    measure(
        "sensor_msgs/msg/Image",
        &format!(r#"{{"height":480,"width":640,"encoding":"rgb8","step":1920,"data":[{pixels}]}}"#),
    );
}
