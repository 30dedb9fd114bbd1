use std::collections::BTreeMap;
use std::io::BufWriter;
use std::time::Instant;

use blaze_flow::types::{Encoding, MessageType, Types};
use mcap::WriteOptions;
use mcap::records::MessageHeader;

use super::*;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo/data").join(name)
}

/// Channel: topic, type, schema encoding, message encoding.
type ChannelText<'a> = (&'a str, &'a str, &'a str, &'a str);

fn write(
    path: &Path,
    compression: Option<mcap::Compression>,
    channels: &[ChannelText<'_>],
    messages: &[(usize, u64, Vec<u8>)],
) {
    let file = BufWriter::new(File::create(path).unwrap());
    let mut writer = WriteOptions::new().compression(compression).create(file).unwrap();
    let ids: Vec<u16> = channels
        .iter()
        .map(|(topic, type_name, schema, encoding)| {
            let schema = writer.add_schema(type_name, schema, b"").unwrap();
            writer.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap()
        })
        .collect();
    for (channel, time, payload) in messages {
        let header = MessageHeader {
            channel_id: ids[*channel],
            sequence: 0,
            log_time: *time,
            publish_time: *time,
        };
        writer.write_to_known_channel(&header, payload).unwrap();
    }
    writer.finish().unwrap();
}

/// What is read of a file of these messages.
fn recorded(
    compression: Option<mcap::Compression>,
    channel: ChannelText<'_>,
    messages: &[(usize, u64, Vec<u8>)],
) -> Recording {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.mcap");
    write(&path, compression, &[channel], messages);
    load_all(&[path], Pictures::Rgb).unwrap().remove(0)
}

fn payload(message: &RecordedMessage) -> &Bytes {
    match &message.body {
        Body::Ready(bytes) => bytes,
        Body::Jpeg(_) => panic!("not decoded"),
    }
}

const IMU: ChannelText<'_> = ("/imu/data", "sensor_msgs/msg/Imu", "ros2msg", "cdr");

fn second(count: u64) -> u64 {
    count * 1_000_000_000
}

#[test]
fn the_jackal_recording_is_read() {
    let recording = &load_all(&[data("jackal.mcap")], Pictures::Rgb).unwrap()[0];
    assert_eq!(recording.messages.len(), 6_121);
    let mut names: Vec<&str> = recording.topics.iter().map(|topic| topic.name.as_str()).collect();
    names.sort_unstable();
    assert_eq!(names, ["imu/data", "jackal_velocity_controller/odom"]);
    for topic in &recording.topics {
        assert!((topic.rate_hz - 50.0).abs() < 0.1, "{topic:?}");
    }
    let imu = recording.topics.iter().find(|topic| topic.name.as_str() == "imu/data").unwrap();
    assert_eq!(imu.encoding, "application/cdr; type=sensor_msgs/msg/Imu");
    assert_eq!(recording.messages[0].offset, Duration::ZERO);
    assert!((recording.period.as_secs_f64() - 61.22).abs() < 0.05, "{:?}", recording.period);
    assert!(recording.messages.is_sorted_by_key(|message| message.offset));
    assert!(recording.skipped.is_empty());
}

#[test]
fn the_program_carries_its_recordings() {
    let recordings = load_built_in(Pictures::Rgb).unwrap();
    let names: Vec<&str> = recordings
        .iter()
        .flat_map(|recording| &recording.topics)
        .map(|topic| topic.name.as_str())
        .collect();
    assert_eq!(names.len(), 3, "{names:?}");
}

#[test]
fn camera_pictures_are_rgb() {
    let start = Instant::now();
    let recording = &load_all(&[data("camera.mcap")], Pictures::Rgb).unwrap()[0];
    eprintln!("camera.mcap read and decoded in {:?}", start.elapsed());
    assert_eq!(recording.topics.len(), 1);
    let topic = &recording.topics[0];
    assert_eq!(topic.name.as_str(), "camera/image_raw");
    assert_eq!((topic.messages, topic.max_bytes), (90, 921_600));
    assert_eq!(topic.encoding, "application/octet-stream");
    assert!((topic.rate_hz - 30.0).abs() < 0.1);
    assert!((recording.period.as_secs_f64() - 3.0).abs() < 0.01, "{:?}", recording.period);
    for message in &recording.messages {
        assert_eq!(payload(message).len(), 640 * 480 * 3);
    }
    // The pan moves: no two frames in a row are the same, and a frame is no single colour.
    assert_ne!(payload(&recording.messages[0]), payload(&recording.messages[1]));
    let first = payload(&recording.messages[0]);
    assert!(first.iter().any(|byte| *byte != first[0]));
}

#[test]
fn camera_pictures_are_images_for_ros_2() {
    let recording = &load_all(&[data("camera.mcap")], Pictures::Image).unwrap()[0];
    let topic = &recording.topics[0];
    assert_eq!(topic.encoding, "application/cdr; type=sensor_msgs/msg/Image");
    let types = Types::default();
    let image = types.get(Instant::now(), MessageType { name: &topic.type_name, hash: "" });
    let picture = payload(&recording.messages[0]);
    let json = image.unwrap().convert(Encoding::Json, picture).unwrap().payload;
    let mut image: serde_json::Value = serde_json::from_slice(&json).unwrap();
    assert_eq!((topic.max_bytes, picture.len()), (52 + 921_600, 52 + 921_600));
    let pixels = image["data"].take();
    assert_eq!(pixels.as_str().unwrap().len(), 921_600 / 3 * 4);
    let stamp = serde_json::json!({"sec": 0, "nanosec": 0});
    let expected = serde_json::json!({
        "header": {"stamp": stamp, "frame_id": "camera"}, "height": 480, "width": 640,
        "encoding": "rgb8", "is_bigendian": 0, "step": 1920, "data": null,
    });
    assert_eq!(image, expected);
}

#[test]
fn pictures_beyond_the_budget_stay_jpeg() {
    let path = data("camera.mcap");
    let mut raw = read_file(&path, &[]).unwrap();
    let mut budget = camera::Budget::of(921_600 * 90 - 1);
    assert_eq!(camera::decode_topics(&mut raw, Pictures::Rgb, &[], &mut budget), 0);
    let recording = raw.finish(&path, Pictures::Rgb);
    assert_eq!(recording.topics[0].name.as_str(), "camera/image_raw");
    assert_eq!(recording.topics[0].max_bytes, 921_600);
    for message in &recording.messages[..3] {
        let Body::Jpeg(jpeg) = &message.body else {
            panic!("decoded in spite of the budget");
        };
        assert_eq!(camera::decode(jpeg, Pictures::Rgb).unwrap().len(), 921_600);
    }
}

#[test]
fn recordings_keep_their_pace_in_any_compression() {
    let messages: Vec<_> =
        (0..5).map(|index| (0, second(100) + index * 20_000_000, vec![index as u8; 9])).collect();
    for compression in [None, Some(mcap::Compression::Zstd), Some(mcap::Compression::Lz4)] {
        let recording = recorded(compression, IMU, &messages);
        assert_eq!(recording.period, Duration::from_millis(100));
        assert_eq!(recording.messages[4].offset, Duration::from_millis(80));
        assert_eq!(payload(&recording.messages[3]), &vec![3; 9]);
        assert_eq!(recording.topics[0].mean_gap(), Duration::from_millis(20));
    }
}

#[test]
fn messages_are_ordered_by_time() {
    let messages = [3, 1, 2].map(|number| (0, second(number), vec![number as u8]));
    let recording = recorded(None, IMU, &messages);
    let order: Vec<u8> = recording.messages.iter().map(|message| payload(message)[0]).collect();
    assert_eq!(order, [1, 2, 3]);
}

#[test]
fn a_single_message_repeats_each_second() {
    let recording = recorded(None, IMU, &[(0, second(7), vec![1])]);
    assert_eq!(recording.period, Duration::from_secs(1));
}

#[test]
fn what_cannot_be_played_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.mcap");
    let channels = [
        IMU,
        ("/old", "std_msgs/String", "ros1msg", "ros1"),
        ("/json", "x", "jsonschema", "json"),
        ("/a topic", "std_msgs/msg/String", "ros2msg", "cdr"),
        ("/blaze/x", "std_msgs/msg/String", "ros2msg", "cdr"),
    ];
    let messages: Vec<_> = (0..5).map(|channel| (channel, second(1), vec![0])).collect();
    write(&path, None, &channels, &messages);
    let recording = &load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap()[0];
    assert_eq!(recording.topics.len(), 1);
    let reasons: Vec<(&str, &SkipReason)> =
        recording.skipped.iter().map(|skipped| (skipped.topic.as_str(), &skipped.reason)).collect();
    assert_eq!(reasons[0], ("/old", &SkipReason::Ros1));
    assert_eq!(reasons[1], ("/json", &SkipReason::Encoding("json".to_owned())));
    assert!(matches!(
        reasons[2],
        ("/a topic", SkipReason::Name(NameError::Character { found: ' ', .. }))
    ));
    assert_eq!(reasons[3], ("/blaze/x", &SkipReason::Name(NameError::Reserved)));

    let error = load_all(&[path.clone(), path], Pictures::Rgb).unwrap_err();
    assert!(error.to_string().contains("/imu/data: imu/data is played already"), "{error}");
}

#[test]
fn files_that_are_no_recording_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("x.mcap");
    for (content, why) in [
        (&b""[..], "the file is empty"),
        (b"hello, this is text", "is no MCAP file"),
        (b"#ROSBAG V2.0\nxxxxxxxx", "ROS 1 bag"),
        (b"SQLite format 3\0xxxxxxx", "ros2 bag convert"),
    ] {
        std::fs::write(&path, content).unwrap();
        let error = load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap_err().to_string();
        assert!(error.contains(why) && error.contains("x.mcap"), "{error}");
    }
    let missing = load_all(&[directory.path().join("none.mcap")], Pictures::Rgb).unwrap_err();
    assert!(matches!(missing, RecordingError::Open { .. }));
    write(&path, None, &[], &[]);
    let error = load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap_err().to_string();
    assert!(error.contains("holds no messages"), "{error}");
}

#[test]
fn a_damaged_file_says_where() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("cut.mcap");
    let whole = std::fs::read(data("jackal.mcap")).unwrap();
    std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let recording = load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap().remove(0);
    let cut = recording.cut.unwrap();
    assert!(cut.starts_with(&format!("after byte {} and ", whole.len() / 2)), "{cut}");
    assert!(recording.messages.len() > 1_000, "{cut}");
    std::fs::write(&path, &whole[..100]).unwrap();
    let error = load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap_err();
    assert!(matches!(error, RecordingError::Broken { .. }), "{error}");
    assert!(error.to_string().contains("after byte 100 and 0 messages"), "{error}");
}

#[test]
fn a_time_without_messages_is_bounded() {
    // A message of a clock that was not set yet.
    let times = [0, second(1_700_000_000), second(1_700_000_001)];
    let messages: Vec<_> = times.map(|time| (0, time, vec![1])).into();
    let recording = recorded(None, IMU, &messages);
    let offsets: Vec<u64> =
        recording.messages.iter().map(|message| message.offset.as_secs()).collect();
    assert_eq!(offsets, [0, 10, 11]);
    assert_eq!(recording.shortened, (1, Duration::from_secs(1_700_000_000)));
    assert!(recording.period <= Duration::from_secs(21));
}

#[test]
fn a_publisher_that_kept_messages_is_known() {
    let directory = tempfile::tempdir().unwrap();
    for (profiles, durability) in [
        ("- history: 1\n  depth: 1\n  durability: 1\n", Durability::TransientLocal),
        ("- durability: transient_local\n", Durability::TransientLocal),
        ("- durability: 2\n- durability: 1\n", Durability::TransientLocal),
        ("- history: 1\n  depth: 1\n  durability: 2\n", Durability::Volatile),
        ("", Durability::Volatile),
    ] {
        let path = directory.path().join("a.mcap");
        let mut writer =
            WriteOptions::new().create(BufWriter::new(File::create(&path).unwrap())).unwrap();
        let schema = writer.add_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"").unwrap();
        let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), profiles.to_owned())]);
        let channel_id = writer.add_channel(schema, "/tf_static", "cdr", &metadata).unwrap();
        let header = MessageHeader { channel_id, sequence: 0, log_time: 7, publish_time: 7 };
        writer.write_to_known_channel(&header, &[1]).unwrap();
        writer.finish().unwrap();
        let recording = load_all(std::slice::from_ref(&path), Pictures::Rgb).unwrap().remove(0);
        assert_eq!(recording.topics[0].durability, durability, "{profiles}");
    }
}

#[test]
fn any_damage_is_an_error_and_no_panic() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bad.mcap");
    let messages: Vec<_> = (0..20).map(|index| (0, second(index), vec![7; 50])).collect();
    write(&path, Some(mcap::Compression::Zstd), &[IMU], &messages);
    let whole = std::fs::read(&path).unwrap();
    for place in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[place] ^= 0xff;
        std::fs::write(&path, damaged).unwrap();
        // Damage in an index or a checksum of the summary may stay unseen; what is read is bounded
        // all the same.
        if let Ok(recordings) = load_all(std::slice::from_ref(&path), Pictures::Rgb) {
            assert!(recordings[0].messages.len() <= messages.len());
        }
    }
}

#[test]
fn a_broken_picture_is_left_out() {
    let whole = read_file(&data("camera.mcap"), &[]).unwrap();
    let frame = |index: usize| match &whole.messages[index].2 {
        Body::Ready(bytes) | Body::Jpeg(bytes) => bytes.to_vec(),
    };
    let mut no_jpeg = frame(1);
    no_jpeg.truncate(40);
    let channel = ("/c/compressed", "sensor_msgs/msg/CompressedImage", "ros2msg", "cdr");
    let messages = [(0, 0, frame(0)), (0, second(1), no_jpeg), (0, second(2), frame(2))];
    let recording = recorded(None, channel, &messages);
    assert_eq!((recording.messages.len(), recording.unusable_messages), (2, 1));
    assert_eq!(recording.topics[0].name.as_str(), "c");
}
