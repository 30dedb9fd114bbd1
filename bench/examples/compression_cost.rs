//! What each level of LZ4 costs and saves on camera frames, on one thread.
//!
//! ```text
//! cargo run --release --example compression_cost -- [FILE [FRAMES]]
//! ```
//!
//! FILE holds raw frames of 640×480 RGB, 921,600 bytes each, one behind the other; without it, or
//! with `-`, frames are made up. FRAMES are measured, 8 unless told otherwise, spread over the
//! file. Columns: milliseconds of processor time to compress a frame (mean and worst) and to
//! decompress it, its size in percent of what it was, and how many frames of 30 Hz streams a
//! processor can do.

#[path = "../../dataplane/src/codec/lz4/image.rs"]
mod image;
#[allow(dead_code, clippy::unwrap_used, reason = "made for tests, which use the rest")]
#[path = "../../dataplane/src/testing/random.rs"]
mod random;
mod testing {
    pub(crate) use crate::random::Random;
}

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail};
use blaze_flow::codec::{lz4, processor_time};

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let file = arguments.next().filter(|file| file != "-");
    let count: usize = match arguments.next() {
        Some(count) => count.parse().context("FRAMES is a number")?,
        None => 8,
    };
    let frames = match &file {
        Some(file) => read(Path::new(file), count.max(1))?,
        None => (0..count.max(1) as u64).map(|number| image::frame(number * 7)).collect(),
    };
    println!(
        "{} frames of {} bytes, {}; LZ4 {}",
        frames.len(),
        image::FRAME_BYTES,
        file.as_deref().unwrap_or("made up"),
        ::lz4::version()
    );
    println!("level  ms/frame   worst  ms back  size %  streams of 30 Hz");
    for level in 1..=lz4::HIGHEST_LEVEL {
        print_level(level, &frames)?;
    }
    Ok(())
}

fn print_level(level: u8, frames: &[Vec<u8>]) -> anyhow::Result<()> {
    let (mut there, mut worst, mut back) = (Duration::ZERO, Duration::ZERO, Duration::ZERO);
    let mut after = 0;
    for frame in frames {
        let began = processor_time();
        let block = lz4::compress(frame, level);
        let took = processor_time().saturating_sub(began);
        (there, worst) = (there + took, worst.max(took));
        let Some(block) = block else {
            after += frame.len();
            continue;
        };
        after += block.len();
        let began = processor_time();
        let payload = lz4::decompress(&block, frame.len() as u64)?;
        back += processor_time().saturating_sub(began);
        if payload != *frame {
            bail!("level {level} does not give back what went in");
        }
    }
    let count = frames.len() as f64;
    let mean = there.as_secs_f64() / count;
    println!(
        "{level:>5} {:>9.2} {:>7.2} {:>8.2} {:>7.1} {:>17.1}",
        mean * 1e3,
        worst.as_secs_f64() * 1e3,
        back.as_secs_f64() / count * 1e3,
        after as f64 / (count * image::FRAME_BYTES as f64) * 100.0,
        1.0 / (30.0 * mean.max(1e-9)),
    );
    Ok(())
}

fn read(file: &Path, count: usize) -> anyhow::Result<Vec<Vec<u8>>> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    let all: Vec<&[u8]> = bytes.chunks_exact(image::FRAME_BYTES).collect();
    if all.is_empty() {
        bail!("{} holds no frame of {} bytes", file.display(), image::FRAME_BYTES);
    }
    let step = (all.len() / count).max(1);
    Ok(all.iter().step_by(step).take(count).map(|frame| frame.to_vec()).collect())
}
