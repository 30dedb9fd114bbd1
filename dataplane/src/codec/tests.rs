//! What becomes of a payload, on any thread.

use super::*;

#[test]
fn payloads_go_there_and_back() {
    let payload = b"0123456789abcdef".repeat(5_000);
    let Done::Compressed(compressed) = Work::Compress(9).run(&payload) else {
        panic!("it was to be compressed");
    };
    assert_eq!((compressed.before, compressed.level), (80_000, 9));
    assert!(
        compressed.after() < 1_000
            && compressed.taken > Duration::ZERO
            && compressed.processor > Duration::ZERO
    );
    let block = compressed.block.unwrap();
    assert_eq!(Work::Decompress(80_000).run(&block), Done::Decompressed(payload.into()));
    assert!(matches!(Work::Decompress(80_001).run(&block), Done::Refused(_)));
    let Done::Compressed(few) = Work::Compress(9).run(b"few") else {
        panic!("it was to be tried");
    };
    assert_eq!((few.block.as_ref(), few.after()), (None, 3));
}

#[test]
fn a_codec_that_panics_has_failed() {
    struct Nasty;
    impl Drop for Nasty {
        fn drop(&mut self) {
            if !std::thread::panicking() {
                panic!("once more");
            }
        }
    }
    assert_eq!(guarded(|| Done::Failed), Done::Failed);
    assert_eq!(guarded(|| panic!("as it is meant to")), Done::Failed);
    assert_eq!(guarded(|| std::panic::panic_any(Nasty)), Done::Failed);
}
