//! The stamp of a ROS `std_msgs/Header` at the start of a message.

use serde::Deserialize;

/// Encapsulation header of a CDR payload.
const ENCAPSULATION_BYTES: usize = 4;
const NANOS_PER_SECOND: i64 = 1_000_000_000;

/// The stamp in ns since 1970 of a CDR payload whose type begins with a header; `None` where there
/// is none, or where it was not set. Plain CDR and CDR2, in both byte orders.
#[must_use]
pub fn header_stamp_cdr(payload: &[u8]) -> Option<i64> {
    let is_little = match payload.get(..2)? {
        [0, 0 | 6] => false,
        [0, 1 | 7] => true,
        _ => return None,
    };
    let word = |at: usize| -> Option<[u8; 4]> {
        payload.get(ENCAPSULATION_BYTES + at..)?.first_chunk().copied()
    };
    let (sec, nanosec) = (word(0)?, word(4)?);
    if is_little {
        stamp(i32::from_le_bytes(sec), u32::from_le_bytes(nanosec))
    } else {
        stamp(i32::from_be_bytes(sec), u32::from_be_bytes(nanosec))
    }
}

/// The stamp in ns since 1970 of a JSON payload, at `/header/stamp`; `None` where there is none, or
/// where it was not set.
#[must_use]
pub fn header_stamp_json(payload: &[u8]) -> Option<i64> {
    #[derive(Deserialize)]
    struct Message {
        header: Header,
    }
    #[derive(Deserialize)]
    struct Header {
        stamp: Stamp,
    }
    #[derive(Deserialize)]
    struct Stamp {
        sec: i32,
        nanosec: u32,
    }
    let Stamp { sec, nanosec } = serde_json::from_slice::<Message>(payload).ok()?.header.stamp;
    stamp(sec, nanosec)
}

/// Zero is a stamp that nobody set.
fn stamp(sec: i32, nanosec: u32) -> Option<i64> {
    let nanos = i64::from(nanosec);
    let is_set = sec > 0 || (sec == 0 && nanos > 0);
    (is_set && nanos < NANOS_PER_SECOND).then(|| i64::from(sec) * NANOS_PER_SECOND + nanos)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn cdr(kind: u8, sec: [u8; 4], nanosec: [u8; 4]) -> Vec<u8> {
        [&[0, kind, 0, 0][..], &sec, &nanosec, b"\x04\0\0\0map\0"].concat()
    }

    #[test]
    fn a_stamp_is_read_in_both_byte_orders_and_from_json() {
        let (sec, nanosec) = (1_767_225_600_i32, 5_000_001_u32);
        let want = Some(1_767_225_600_005_000_001);
        for kind in [0, 6] {
            let payload = cdr(kind, sec.to_be_bytes(), nanosec.to_be_bytes());
            assert_eq!(header_stamp_cdr(&payload), want);
        }
        for kind in [1, 7] {
            let payload = cdr(kind, sec.to_le_bytes(), nanosec.to_le_bytes());
            assert_eq!(header_stamp_cdr(&payload), want);
        }
        let message = json!({ "data": [1, 2], "header": {
            "frame_id": "map", "stamp": { "sec": sec, "nanosec": nanosec } } });
        assert_eq!(header_stamp_json(message.to_string().as_bytes()), want);
    }

    #[test]
    fn what_is_no_stamp_or_was_not_set_is_none() {
        let unset = cdr(1, [0; 4], [0; 4]);
        let nanos = cdr(1, 5_i32.to_le_bytes(), 1_000_000_000_u32.to_le_bytes());
        let early = cdr(1, (-5_i32).to_le_bytes(), 1_u32.to_le_bytes());
        let list = cdr(3, 5_i32.to_le_bytes(), 1_u32.to_le_bytes());
        for payload in [unset, nanos, early, list] {
            assert_eq!(header_stamp_cdr(&payload), None);
        }
        for payload in [r#"{"header":{}}"#, "[]", r#"{"header":{"stamp":{"sec":"1"}}}"#, "\u{1}"] {
            assert_eq!(header_stamp_json(payload.as_bytes()), None);
        }
    }

    proptest! {
        #[test]
        fn no_input_panics(payload in prop::collection::vec(any::<u8>(), 0..24)) {
            let _ = header_stamp_cdr(&payload);
            let _ = header_stamp_json(&payload);
        }
    }
}
