//! Every level gives back what went in, and nothing that comes from outside takes more than it may.

use super::image::{FRAME_BYTES, frame};
use super::*;
use crate::testing::Random;
use proptest::prelude::*;
use std::time::{Duration, Instant};

fn inputs() -> usize {
    if std::env::var_os("BLAZE_LONG").is_some() { 100_000 } else { 5_000 }
}

/// What a payload becomes on its way, and that it fits.
fn there_and_back(payload: &[u8], level: u8) -> Option<usize> {
    let block = compress(payload, level)?;
    assert!(
        block.len() * 100 <= payload.len() * 97,
        "level {level}: {} of {}",
        block.len(),
        payload.len()
    );
    let back = decompress(&block, payload.len() as u64).unwrap();
    assert!(back == payload, "level {level}, {} bytes", payload.len());
    Some(block.len())
}

/// librdkafka brings an LZ4 of its own; with both in one program the linker would take either, and
/// the levels differ.
#[test]
fn the_linked_lz4_is_the_one_that_was_built_for_us() {
    assert_eq!(::lz4::version(), 11_000, "rdkafka needs its feature external-lz4");
}

#[test]
fn every_level_gives_back_a_camera_frame() {
    let frame = frame(1);
    assert_eq!(frame.len(), FRAME_BYTES);
    let sizes: Vec<usize> = (1..=12).map(|level| there_and_back(&frame, level).unwrap()).collect();
    assert!(sizes[9] < sizes[0], "level 10 saves more than level 1: {sizes:?}");
    assert_eq!(sizes[0], sizes[1], "LZ4 has one fast mode");
    for (level, as_if) in [(0, 1), (13, 12), (255, 12)] {
        assert_eq!(there_and_back(&frame, level), Some(sizes[as_if - 1]), "level {level}");
    }
}

#[test]
fn every_level_takes_what_is_small_long_or_repeats() {
    for level in 1..=12 {
        for length in 0..40 {
            let few = vec![b'x'; length];
            assert!(there_and_back(&few, level).is_none_or(|_| length >= SMALLEST), "{length}");
        }
        let repeated = vec![7; 300_000];
        let length = there_and_back(&repeated, level).unwrap();
        assert!(length < 1_500, "{length}");
        let text = b"0123456789abcdef".repeat(5_000);
        assert!(there_and_back(&text, level).unwrap() < 1_000);
    }
    assert!(there_and_back(&vec![0; MAX_PAYLOAD_BYTES], 3).is_some());
    assert_eq!(compress(&vec![0; MAX_PAYLOAD_BYTES + 1], 1), None);
}

#[test]
fn what_does_not_become_smaller_goes_as_it_is() {
    let mut noise = Random(3);
    let random: Vec<u8> = (0..200_000).map(|_| noise.byte()).collect();
    for level in [1, 3, 9, 10, 12] {
        assert_eq!(compress(&random, level), None);
        // Two percent of it could be saved.
        let mut nearly = random.clone();
        nearly[50_000..54_000].fill(0);
        assert_eq!(compress(&nearly, level), None);
        nearly[100_000..104_000].fill(0);
        assert!(there_and_back(&nearly, level).is_some());
    }
}

#[test]
fn the_result_holds_no_more_memory_than_it_has_bytes() {
    let block = compress(&frame(2), 1).unwrap();
    let length = block.len();
    let vec = Vec::from(block);
    assert!(vec.capacity() <= length + 64, "{} for {length}", vec.capacity());
}

#[test]
fn a_size_is_checked_before_memory_is_taken_for_it() {
    let refused = |block, announced| check(block, announced).unwrap_err();
    let too_large = MAX_PAYLOAD_BYTES as u64 + 1;
    for announced in [too_large, u64::MAX] {
        assert_eq!(refused(1 << 20, announced), Refused::TooLarge { announced });
    }
    assert!(matches!(refused(10, 2_551), Refused::Impossible { found: 10, .. }));
    assert!(matches!(refused(0, 1), Refused::Impossible { .. }));
    assert!(matches!(refused(MAX_PAYLOAD_BYTES + 1, 1), Refused::BlockTooLarge { .. }));
    assert!(matches!(refused(usize::MAX, 1), Refused::BlockTooLarge { .. }));
    assert_eq!(check(10, 2_550), Ok((2_550, 2_550)));
    assert_eq!(announced_size(MAX_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES as u64), Ok(MAX_PAYLOAD_BYTES));
}

#[test]
fn the_ratio_of_the_best_block_is_allowed() {
    // Nothing compresses better than the same byte again and again.
    for level in [1, 12] {
        let block = compress(&vec![0; MAX_PAYLOAD_BYTES], level).unwrap();
        assert!(block.len() * 255 >= MAX_PAYLOAD_BYTES, "{}", block.len());
        assert!(block.len() * 250 < MAX_PAYLOAD_BYTES, "{}", block.len());
    }
}

#[test]
fn only_the_announced_size_is_accepted() {
    let payload = b"0123456789abcdef".repeat(100);
    let block = compress(&payload, 9).unwrap();
    for announced in [0, 1, 1_599, 1_601, 3_000] {
        assert!(decompress(&block, announced).is_err(), "{announced}");
    }
    assert_eq!(decompress(&block, 1_600).unwrap(), payload);
    assert_eq!(
        decompress(&block, 1_700),
        Err(Refused::OtherSize { announced: 1_700, found: 1_600 })
    );
    assert_eq!(decompress(&block, 1_500), Err(Refused::Damaged { announced: 1_500 }));
    assert!(decompress(b"", 0).is_err());
    assert_eq!(decompress(&[0], 0).unwrap(), Bytes::new());
}

/// A block as it might come from outside: damaged in some way, and a size that somebody announces
/// for it.
fn strange_block(noise: &mut Random, good: &[(Bytes, usize)]) -> (Vec<u8>, u64) {
    let (block, size) = &good[noise.index(good.len())];
    let (mut bytes, mut announced) = (block.to_vec(), *size as u64);
    match noise.index(8) {
        0 => {
            for _ in 0..=noise.index(3) {
                let at = noise.index(bytes.len());
                bytes[at] = noise.byte();
            }
        }
        1 => bytes.truncate(noise.index(bytes.len())),
        2 => bytes = (0..noise.index(2_000)).map(|_| noise.byte()).collect(),
        3 => announced = noise.next() >> noise.index(64),
        // A bomb: one byte, then the longest match there can be, cut off or not.
        4 => {
            bytes = vec![0x1f, 7, 1, 0];
            bytes.extend(std::iter::repeat_n(255, noise.index(70_000)));
            bytes.extend_from_slice(&[100, 0x50, 1, 2, 3, 4, 5][noise.index(7)..]);
            announced = bytes.len() as u64 * 255 - noise.index(2_000) as u64;
        }
        // Part of one block in another, and the end of one behind the other.
        5 => {
            let (other, _) = &good[noise.index(good.len())];
            let at = noise.index(bytes.len());
            bytes.truncate(at);
            bytes.extend_from_slice(&other[noise.index(other.len())..]);
        }
        // Offsets that point before the beginning.
        6 => {
            for _ in 0..4 {
                let at = noise.index(bytes.len());
                bytes[at..].iter_mut().take(2).for_each(|byte| *byte = 0xff);
            }
        }
        // A good one.
        _ => {}
    }
    (bytes, announced)
}

/// 5,000 inputs, or 100,000 with `BLAZE_LONG`. What is given has the announced size, which is
/// within the bound, and no other memory is taken: that for the result is the only one, and
/// [`check`] comes before it.
#[test]
fn codec_inputs() {
    let mut noise = Random(20_261_122);
    let image = frame(5);
    let good: Vec<(Bytes, usize)> = (0..40)
        .map(|_| {
            let length = 100 + noise.index(20_000);
            let at = noise.index(image.len() - length);
            let level = u8::try_from(1 + noise.index(12)).unwrap();
            // Every other byte, so that there are few long matches and many short ones.
            let part: Vec<u8> = image[at..at + length].iter().map(|byte| byte & 0xfc).collect();
            (compress(&part, level).unwrap(), length)
        })
        .collect();
    let (mut taken, mut refused, mut longest) = (0, 0, Duration::ZERO);
    for number in 0..inputs() {
        let (block, announced) = strange_block(&mut noise, &good);
        let began = Instant::now();
        match decompress(&block, announced) {
            Ok(payload) => {
                assert_eq!(payload.len() as u64, announced, "input {number}");
                let capacity = Vec::from(payload).capacity();
                assert!(capacity <= MAX_PAYLOAD_BYTES, "input {number}: {capacity}");
                taken += 1;
            }
            Err(reason) => {
                let before_memory =
                    !matches!(reason, Refused::Damaged { .. } | Refused::OtherSize { .. });
                let allowed =
                    announced <= MAX_PAYLOAD_BYTES as u64 && announced <= block.len() as u64 * 255;
                assert_eq!(before_memory, !allowed, "input {number}: {reason}");
                refused += 1;
            }
        }
        longest = longest.max(began.elapsed());
    }
    assert!(taken > inputs() / 20 && refused > inputs() / 2, "{taken} taken, {refused} refused");
    assert!(longest < Duration::from_secs(5), "{longest:?}");
    println!("{taken} taken, {refused} refused, longest {longest:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_payload_comes_back(
        parts in proptest::collection::vec((any::<u8>(), 0usize..600, any::<bool>()), 0..12),
        seed: u64,
        level in 1u8..=12,
    ) {
        let mut noise = Random(seed);
        let mut payload = Vec::new();
        for (byte, length, random) in parts {
            payload.extend((0..length).map(|_| if random { noise.byte() } else { byte }));
        }
        there_and_back(&payload, level);
    }
}
