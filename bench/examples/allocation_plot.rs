//! Draws `docs/design/bandwidth.svg`: the rates that topics get, over the limit.
//!
//! `cargo run --release --example allocation_plot > docs/design/bandwidth.svg`

use std::fmt::Write as _;

use blaze_flow::limit::allocate::{Lane, Sharing, Terms, Topic, allocate};

/// The worked example of `docs/design/bandwidth.md`: name, payload in bytes, rate in Hz, colour.
const TOPICS: [(&str, u64, f64, &str); 3] = [
    ("camera/front", 921_600, 30.0, "#c0392b"),
    ("camera/rear", 500_000, 30.0, "#e08e0b"),
    ("imu/data", 400, 50.0, "#2471a3"),
];
const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 240.0;
/// Of each panel, for axes and words.
const MARGIN: f64 = 46.0;
/// Largest limit, in Mbit/s of 1024² bit.
const MOST_MBPS: f64 = 400.0;
/// Highest rate, in Hz.
const MOST_HZ: f64 = 55.0;

fn main() {
    let mut svg = String::new();
    let (all_width, all_height) = (2.0 * WIDTH, HEIGHT + 34.0);
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {all_width} {all_height}\" \
         font-family=\"sans-serif\" font-size=\"11\">"
    );
    let _ = writeln!(svg, "<rect width=\"100%\" height=\"100%\" fill=\"white\"/>");
    for (at, (sharing, title)) in
        [(Sharing::Paper, "share: paper"), (Sharing::Fair, "share: fair")].into_iter().enumerate()
    {
        panel(&mut svg, at as f64 * WIDTH, sharing, title);
    }
    for (at, (name, _, _, colour)) in TOPICS.iter().enumerate() {
        let x = MARGIN + 150.0 * at as f64;
        let y = HEIGHT + 20.0;
        let _ = writeln!(
            svg,
            "<line x1=\"{x}\" y1=\"{y}\" x2=\"{}\" y2=\"{y}\" stroke=\"{colour}\" \
             stroke-width=\"2\"/><text x=\"{}\" y=\"{}\">{name}</text>",
            x + 22.0,
            x + 28.0,
            y + 4.0
        );
    }
    svg.push_str("</svg>\n");
    print!("{svg}");
}

fn panel(svg: &mut String, left: f64, sharing: Sharing, title: &str) {
    let x = |mbps: f64| left + MARGIN + (WIDTH - MARGIN - 12.0) * mbps / MOST_MBPS;
    let y = |hz: f64| HEIGHT - 30.0 - (HEIGHT - 60.0) * hz / MOST_HZ;
    let _ = writeln!(svg, "<text x=\"{}\" y=\"18\" font-weight=\"bold\">{title}</text>", x(0.0));
    for hz in [0.0, 10.0, 20.0, 30.0, 40.0, 50.0] {
        let _ = writeln!(
            svg,
            "<line x1=\"{}\" y1=\"{2}\" x2=\"{1}\" y2=\"{2}\" stroke=\"#ddd\"/><text x=\"{3}\" \
             y=\"{4}\" text-anchor=\"end\">{hz}</text>",
            x(0.0),
            x(MOST_MBPS),
            y(hz),
            x(0.0) - 6.0,
            y(hz) + 4.0
        );
    }
    for mbps in [0.0, 100.0, 200.0, 300.0, 400.0] {
        let _ = writeln!(
            svg,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{mbps}</text>",
            x(mbps),
            y(0.0) + 16.0
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">limit_mbps</text><text x=\"{}\" \
         y=\"{}\">Hz</text>",
        x(MOST_MBPS),
        y(0.0) + 28.0,
        x(0.0) - 24.0,
        y(MOST_HZ) - 2.0
    );
    let topics: Vec<Topic<'_>> = TOPICS
        .iter()
        .map(|(name, size_bytes, advertised_hz, _)| Topic {
            name,
            size_bytes: *size_bytes,
            advertised_hz: *advertised_hz,
            class: None,
            lanes: vec![Lane { max_rate_hz: None }],
        })
        .collect();
    let terms = Terms { sharing, ..Terms::default() };
    for (at, (_, _, _, colour)) in TOPICS.iter().enumerate() {
        let mut points = String::new();
        for step in 1..=400 {
            let mbps = f64::from(step) * MOST_MBPS / 400.0;
            let granted = allocate(mbps * 1024.0 * 1024.0 / 8.0, &terms, &topics);
            let _ = write!(points, "{:.1},{:.1} ", x(mbps), y(granted.grants[at].rate_hz));
        }
        let _ = writeln!(
            svg,
            "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" points=\"{}\"/>",
            points.trim_end()
        );
    }
}
