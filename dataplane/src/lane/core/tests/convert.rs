//! Payloads in another encoding than was published. The test is the pool: nothing is converted
//! there before it says so.

mod property;

use blaze_convert::{Distro, Source, TypeDescription, parse_joined};
use blaze_domain::WhyCode;
use tokio::sync::mpsc::{Receiver, channel};

use super::*;
use crate::codec::pool::Urgency;
use crate::codec::{Done, guarded};
use crate::lane::compress_stage::CodecJob;
use crate::types::{MessageType, TopicTypes, Types, Wanted, Wish};

const STRING: &str = "std_msgs/msg/String";
const CUSTOM: &str = "my_msgs/msg/Level";
const TWIST: &str = "geometry_msgs/msg/Twist";
/// Converted by the pool.
const LARGE: usize = 20_000;

/// A flow with bridges for other encodings, and what the pool has begun.
struct Hands {
    bench: Bench,
    /// What is written to the layer, in tests that tell the two apart.
    of_layer: Arc<Collector>,
    jobs: Vec<CodecJob>,
}

fn copy(from: Scope) -> Bridge {
    bridge(from, Target::Node(Form::Json))
}

fn types(published: Option<&str>, wanted: Wanted) -> TopicInfo {
    let ty = |name: &str| MessageType { name: name.to_owned(), hash: String::new() };
    let types = TopicTypes { published: published.map(ty), wanted };
    TopicInfo { types, ..TopicInfo::default() }
}

fn wants(name: &str) -> Wanted {
    Wanted::Type(MessageType { name: name.to_owned(), hash: String::new() })
}

/// The CDR of a string.
fn string(text: &str) -> Vec<u8> {
    let mut cdr = vec![0, 1, 0, 0];
    cdr.extend(u32::try_from(text.len() + 1).unwrap().to_le_bytes());
    cdr.extend(text.as_bytes());
    cdr.push(0);
    cdr
}

fn of(encoding: &str, writer: u8, sequence: u64, payload: impl Into<Bytes>) -> Frame {
    let plain = frame(writer, sequence, "robot-1", 0, 0);
    plain.recoded(encoding, "", payload.into()).unwrap()
}

/// A string as ROS 2 publishes it.
fn ros(sequence: u64, text: &str) -> Frame {
    of(&format!("application/cdr; type={STRING}"), 1, sequence, string(text))
}

fn json(sequence: u64, text: &str) -> Frame {
    of("application/json", 1, sequence, text.to_owned())
}

impl Hands {
    fn new(bridges: Vec<Bridge>, info: TopicInfo) -> Self {
        let mut bench = Bench::new(Vec::new());
        bench.apply(bridges, info);
        Self { bench, of_layer: Arc::default(), jobs: Vec::new() }
    }

    fn with_pool(bridges: Vec<Bridge>, info: TopicInfo) -> Self {
        let mut hands = Self::new(bridges, info);
        hands.bench.core.enable_compression();
        // Types that are known are converted at once.
        for name in [STRING, TWIST] {
            let ty = MessageType { name, hash: "" };
            hands.bench.core.types.get(hands.bench.now, ty).unwrap();
        }
        hands
    }

    fn publish(&mut self, frame: Frame) {
        self.bench.take(Scope::Node, vec![Content::Frame(frame)]);
    }

    fn begin(&mut self) {
        let requests = self.bench.core.take_pool_requests();
        for (count, urgency) in [(requests.quick, Urgency::Quick), (requests.long, Urgency::Long)] {
            for _ in 0..count {
                let Bench { core, link, now, .. } = &mut self.bench;
                self.jobs.extend(core.begin(*now, urgency, link));
            }
        }
    }

    fn end(&mut self, at: usize) {
        let job = self.jobs.remove(at);
        let done = guarded(|| job.work.run(&job.payload));
        self.end_with(&job, done);
    }

    fn end_with(&mut self, job: &CodecJob, done: Done) {
        let Bench { core, link, now, .. } = &mut self.bench;
        core.finished(*now, job.ticket, done, link);
    }

    fn run(&mut self) {
        self.begin();
        while !self.jobs.is_empty() {
            self.end(0);
            self.begin();
        }
    }

    /// The texts without a header that were written.
    fn texts(&self) -> Vec<String> {
        let text = |payload: &Bytes| String::from_utf8(payload.to_vec()).unwrap();
        self.bench.out.bare.lock().iter().map(text).collect()
    }

    fn dropped(&self, at: usize) -> Vec<(DropReason, u64)> {
        self.bench.core.path(self.bench.topic).bridges[at].stats.dropped.iter().collect()
    }

    /// Code and detail of the last failure of a bridge.
    fn failure(&self, at: usize) -> (WhyCode, String) {
        let bridge = &self.bench.core.path(self.bench.topic).bridges[at];
        let failure = bridge.unconverted.clone().unwrap().failure;
        (failure.code, failure.to_string())
    }
}

#[test]
fn cdr_becomes_json_and_json_goes_as_it_is() {
    let mut hands = Hands::new(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(1, "a"));
    hands.publish(json(2, "{ \"data\" : 1}"));
    hands.publish(of("Application/JSON; charset=utf-8", 1, 3, "no JSON, but who says so is heard"));
    assert_eq!(
        hands.texts(),
        [r#"{"data":"a"}"#, "{ \"data\" : 1}", "no JSON, but who says so is heard"]
    );
    let stats = hands.bench.core.path(hands.bench.topic).convert_stats;
    assert_eq!((stats.json, stats.cdr), (1, 0));
    assert!(stats.seconds > 0.0);
}

#[test]
fn the_type_is_that_of_the_message_else_that_of_the_lease() {
    let bridges = || vec![copy(Scope::Node)];
    let cdr = |encoding: &str| of(encoding, 1, 1, string("a"));
    let mut hands = Hands::new(bridges(), types(Some(STRING), Wanted::Nothing));
    hands.publish(cdr("application/cdr"));
    assert_eq!(hands.texts(), [r#"{"data":"a"}"#]);
    let mut hands = Hands::new(bridges(), types(Some(TWIST), Wanted::Nothing));
    hands.publish(cdr(&format!("application/cdr; type={STRING}")));
    assert_eq!(hands.texts(), [r#"{"data":"a"}"#]);
    let mut hands = Hands::new(bridges(), TopicInfo::default());
    hands.publish(cdr("application/cdr"));
    let (code, detail) = hands.failure(0);
    assert_eq!(code, WhyCode::TypeUnknown);
    assert_eq!(detail, "neither the message nor its publisher names the type of the CDR");
    let with_hash = ros(2, "a");
    let encoding = with_hash.encoding();
    let hash = format!("RIHS01_{}", "0".repeat(64));
    hands.publish(with_hash.recoded(encoding, &hash, with_hash.payload().clone()).unwrap());
    assert_eq!(hands.failure(0).1, format!("no definition of {STRING} with the hash {hash}"));
    assert_eq!(hands.dropped(0), [(DropReason::ConvertError, 2)]);
}

#[test]
fn what_cannot_be_converted_is_dropped_with_its_reason_and_the_next_passes() {
    let info = types(None, wants(TWIST));
    let mut hands = Hands::new(vec![bridge(Scope::Node, Target::Ros2)], info);
    hands.publish(json(1, r#"{"linear":{"x":"fast"}}"#));
    assert_eq!(
        hands.failure(0),
        (WhyCode::ConvertError, "/linear/x: expected a number, found text".to_owned())
    );
    hands.publish(json(2, r#"{"linear":{"x":1}}"#));
    assert_eq!(hands.bench.written(), [2]);
    hands.publish(of("application/octet-stream", 1, 4, "x"));
    assert_eq!(hands.failure(0).1, "application/octet-stream is not converted to CDR");
    hands.publish(of("", 1, 5, "x"));
    assert_eq!(hands.failure(0).1, "a payload without an encoding is not converted to CDR");
    hands.publish(json(6, &format!(r#"{{"{}":1}}"#, "é".repeat(5_000))));
    assert!(hands.failure(0).1.len() < 620, "pointer and detail are bounded");
    let dropped = [(DropReason::ConvertError, 4)];
    assert_eq!(hands.dropped(0), dropped);
}

#[test]
fn json_above_the_limit_is_too_large() {
    let mut hands = Hands::new(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(1, &"\u{1}".repeat(3 * 1024 * 1024)));
    assert_eq!(hands.failure(0), (WhyCode::TooLarge, "larger than 16777216 bytes".to_owned()));
    assert_eq!(hands.dropped(0), [(DropReason::TooLarge, 1)]);
}

#[test]
fn json_becomes_cdr_of_the_reader_with_type_and_hash() {
    let mut hands = Hands::new(vec![bridge(Scope::Node, Target::Ros2)], types(None, wants(STRING)));
    hands.publish(json(1, r#"{"data":"a"}"#));
    let found = hands.bench.core.types.get(hands.bench.now, MessageType { name: STRING, hash: "" });
    let written = hands.bench.out.frames.lock()[0].clone();
    assert_eq!(&written.payload()[..], string("a"));
    assert_eq!(written.encoding(), format!("application/cdr; type={STRING}"));
    assert_eq!(written.type_hash(), found.unwrap().hash.to_string());
    assert_eq!((written.sequence(), written.hops()), (1, 1));
    hands.publish(ros(2, "b"));
    assert_eq!(hands.bench.written(), [1, 2], "CDR goes as it is");
    assert_eq!(hands.bench.core.path(hands.bench.topic).convert_stats.cdr, 1);

    let mut hands =
        Hands::new(vec![bridge(Scope::Node, Target::Ros2)], types(Some(STRING), Wanted::Nothing));
    hands.publish(of("application/cdr", 1, 1, string("a")));
    let written = hands.bench.out.frames.lock()[0].clone();
    assert_eq!(written.encoding(), format!("application/cdr; type={STRING}"), "of the lease");
    hands.publish(json(2, "{}"));
    assert_eq!(hands.failure(0).0, WhyCode::TypeUnknown);

    let mismatch = Wanted::Mismatch("a/msg/B is published, readers ask for a/msg/C".to_owned());
    let mut hands = Hands::new(vec![bridge(Scope::Node, Target::Ros2)], types(None, mismatch));
    hands.publish(json(1, "{}"));
    assert_eq!(hands.failure(0).0, WhyCode::TypeMismatch);
    assert_eq!(hands.dropped(0), [(DropReason::TypeMismatch, 1)]);
}

#[test]
fn a_message_is_converted_once_for_all_bridges_that_admit_it() {
    let thinned = Bridge {
        lane: lane_with(|lane| lane.max_rate_hz = Some(1.0)),
        ..bridge(Scope::Node, Target::Layer { json: true })
    };
    let framed = bridge(Scope::Node, Target::Layer { json: false });
    let mut hands = Hands::new(vec![copy(Scope::Node), thinned, framed], TopicInfo::default());
    hands.publish(ros(1, "a"));
    hands.publish(ros(2, "b"));
    hands.publish(ros(3, "c"));
    let stats = hands.bench.core.path(hands.bench.topic).convert_stats;
    assert_eq!(stats.json, 3, "one conversion for two bridges");
    assert_eq!(hands.texts().len(), 5);
    assert_eq!(hands.dropped(1), [(DropReason::MaxRate, 1)]);
    assert_eq!(hands.bench.written(), [1, 2, 3]);
    assert!(
        hands.bench.out.frames.lock().iter().all(|frame| frame.encoding() != "application/json")
    );
    let mut hands = Hands::new(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    hands.publish(ros(1, "a"));
    let stats = hands.bench.core.path(hands.bench.topic).convert_stats;
    assert_eq!(stats.json, 0, "nobody asked for it");
}

/// A custom type that others are asked for; what they are asked stays in the queue.
fn custom() -> (Hands, TypeDescription, Receiver<Wish>) {
    let definition = parse_joined(CUSTOM, "int32 level\n", None).unwrap();
    let (wishes, queue) = channel(8);
    let mut hands = Hands::new(vec![copy(Scope::Node)], types(Some(CUSTOM), Wanted::Nothing));
    let types = Types::new(Distro::Jazzy, Vec::new()).asking(wishes);
    hands.bench.core.set_types(Arc::new(types));
    hands.bench.core.enable_compression();
    (hands, definition, queue)
}

fn level(sequence: u64, level: i32) -> Frame {
    let cdr = [&[0, 1, 0, 0], &level.to_le_bytes()[..]].concat();
    of("application/cdr", 1, sequence, cdr)
}

#[test]
fn messages_wait_while_others_are_asked_for_their_type() {
    let (mut hands, definition, mut queue) = custom();
    for sequence in 1..=3 {
        hands.publish(level(sequence, 7));
        hands.run();
    }
    let types = Arc::clone(&hands.bench.core.types);
    let ty = queue.try_recv().unwrap().ty;
    assert!(queue.try_recv().is_err() && types.is_sought(&ty), "it is asked for once");
    hands.publish(of("application/json", 1, 4, "{}"));
    hands.bench.core.look_for_types(hands.bench.now);
    assert!(!hands.bench.core.has_pool_requests(), "nobody works on them");
    assert_eq!((hands.texts().len(), hands.dropped(0)), (0, Vec::new()));
    types.add(Source::Node, definition).unwrap();
    types.sought(&ty);
    hands.bench.core.look_for_types(hands.bench.now);
    hands.run();
    assert_eq!(hands.texts(), [r#"{"level":7}"#, r#"{"level":7}"#, r#"{"level":7}"#, "{}"]);
    hands.publish(level(5, 8));
    assert_eq!(hands.texts()[4], r#"{"level":8}"#, "at once");
}

#[test]
fn messages_wait_for_some_seconds_at_most() {
    let (mut hands, _, mut queue) = custom();
    let converts = |count| vec![(DropReason::ConvertError, count)];
    hands.publish(level(1, 7));
    hands.publish(level(2, 7));
    hands.run();
    let ty = queue.try_recv().unwrap().ty;
    hands.bench.core.types.sought(&ty);
    hands.bench.core.look_for_types(hands.bench.now);
    hands.run();
    assert_eq!(hands.dropped(0), converts(2), "nobody has it");
    assert_eq!(hands.failure(0).0, WhyCode::TypeUnknown);
    hands.publish(level(3, 7));
    assert_eq!(hands.dropped(0), converts(3), "it was sought a moment ago");
    hands.bench.now += Duration::from_secs(5);
    hands.publish(level(4, 7));
    hands.run();
    hands.bench.now += Duration::from_secs(1);
    hands.publish(level(5, 7));
    hands.run();
    assert!(hands.bench.core.types.is_sought(&ty));
    hands.bench.now += Duration::from_secs(9);
    hands.bench.core.look_for_types(hands.bench.now);
    hands.run();
    assert_eq!(hands.dropped(0), converts(4), "nobody answers");
    let Bench { core, link, now, .. } = &mut hands.bench;
    core.stop_compression(*now, link);
    assert!(!core.compress.delays_any());
    assert_eq!(
        hands.dropped(0).iter().map(|(_, count)| count).sum::<u64>(),
        5,
        "what waits for its type is dropped with the pool"
    );
}

#[test]
fn large_messages_go_to_the_pool_and_are_not_overtaken() {
    let mut hands = Hands::with_pool(vec![copy(Scope::Node)], TopicInfo::default());
    let long = "x".repeat(LARGE);
    hands.publish(ros(1, "small"));
    hands.publish(ros(2, &long));
    hands.publish(ros(3, "small"));
    hands.publish(json(4, "4"));
    hands.publish(ros(5, &long));
    let of_other = of(&format!("application/cdr; type={STRING}"), 2, 1, string("other"));
    hands.publish(of_other);
    let data = |text: &str| format!(r#"{{"data":"{text}"}}"#);
    assert_eq!(hands.texts(), [data("small"), data("other")], "other writers do not wait");
    hands.begin();
    assert_eq!(hands.jobs.len(), 2);
    hands.end(1);
    assert_eq!(hands.texts().len(), 2);
    hands.end(0);
    let rest: Vec<String> = hands.texts().split_off(2);
    assert_eq!(rest, [data(&long), data("small"), "4".to_owned(), data(&long)]);
    let bridge = &hands.bench.core.path(hands.bench.topic).bridges[0];
    assert_eq!((bridge.in_codec, bridge.stats.taken.messages), (0, 6));
}

#[test]
fn a_type_is_sought_by_the_pool() {
    let mut hands = Hands::new(vec![copy(Scope::Node)], TopicInfo::default());
    hands.bench.core.enable_compression();
    hands.publish(ros(1, "a"));
    hands.publish(of("application/cdr; type=no/msg/Such", 1, 2, string("b")));
    hands.publish(ros(3, "c"));
    assert!(hands.texts().is_empty());
    hands.run();
    assert_eq!(hands.texts(), [r#"{"data":"a"}"#, r#"{"data":"c"}"#]);
    assert_eq!(hands.failure(0), (WhyCode::TypeUnknown, "no definition of no/msg/Such".to_owned()));
    hands.publish(ros(4, "d"));
    assert_eq!(hands.texts().len(), 3, "it is known now");
}

#[test]
fn native_cdr_does_not_wait_for_json() {
    let bridges = vec![copy(Scope::Inter), bridge(Scope::Inter, Target::Ros2)];
    let mut hands = Hands::with_pool(bridges, TopicInfo::default());
    let long = ros(1, &"x".repeat(LARGE));
    let from_fog = from_fog(1, 0);
    let message = from_fog.recoded(long.encoding(), "", long.payload().clone()).unwrap();
    hands.bench.deliver(message);
    assert_eq!((hands.bench.written().len(), hands.texts().len()), (1, 0));
    assert!(hands.bench.core.has_unwritten());
    hands.run();
    assert_eq!(hands.texts().len(), 1);
    assert!(!hands.bench.core.has_unwritten());
}

#[test]
fn a_message_that_waits_grows_older_and_expires() {
    let mut bridge = bridge(Scope::Node, Target::Ros2);
    bridge.lane.lifespan_ms = 50;
    let mut hands = Hands::with_pool(vec![bridge], types(None, wants(STRING)));
    let long = format!(r#"{{"data":"{}"}}"#, "x".repeat(LARGE));
    hands.publish(json(1, &long));
    hands.bench.now += Duration::from_millis(30);
    hands.run();
    assert_eq!(hands.bench.out.frames.lock()[0].age_us(), 30_000);
    hands.publish(json(2, &long));
    hands.bench.now += Duration::from_millis(50);
    hands.run();
    assert_eq!(hands.dropped(0), [(DropReason::Lifespan, 1)]);
    assert_eq!(hands.bench.written(), [1]);
}

#[test]
fn failures_are_reported_once_a_second() {
    let mut hands = Hands::new(vec![copy(Scope::Node)], TopicInfo::default());
    for sequence in 1..=5 {
        hands.publish(of("text/plain", 1, sequence, "x"));
        hands.bench.now += Duration::from_millis(300);
    }
    let reported = hands.bench.core.take_convert_failures();
    assert_eq!(reported.len(), 2);
    assert_eq!(reported[0].0.as_str(), "imu/data");
    assert_eq!(reported[0].1.detail, "text/plain is not converted to JSON");
    assert!(hands.bench.core.take_convert_failures().is_empty());
    assert_eq!(hands.dropped(0), [(DropReason::ConvertError, 5)]);
}

#[test]
fn a_converter_that_panics_costs_one_message() {
    let mut hands = Hands::with_pool(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(1, &"x".repeat(LARGE)));
    hands.publish(ros(2, "b"));
    hands.begin();
    let job = hands.jobs.remove(0);
    hands.end_with(&job, Done::Failed);
    assert_eq!(hands.texts(), [r#"{"data":"b"}"#]);
    assert_eq!(hands.failure(0).1, "the converter failed");
}

#[test]
fn a_bridge_empties_before_it_ends_and_what_comes_later_is_counted() {
    let mut hands = Hands::with_pool(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(1, &"x".repeat(LARGE)));
    hands.begin();
    hands.bench.apply(Vec::new(), TopicInfo::default());
    hands.bench.drain();
    hands.end(0);
    assert_eq!(hands.texts().len(), 1, "it was on its way");
    hands.bench.apply(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(2, &"x".repeat(LARGE)));
    hands.begin();
    hands.bench.apply(Vec::new(), TopicInfo::default());
    hands.bench.now += Duration::from_secs(1);
    hands.bench.drain();
    hands.end(0);
    assert_eq!(hands.dropped(0), [(DropReason::NoDestination, 1)]);
}

#[test]
fn without_a_pool_everything_is_converted_at_once() {
    let mut hands = Hands::with_pool(vec![copy(Scope::Node)], TopicInfo::default());
    hands.publish(ros(1, &"x".repeat(LARGE)));
    let Bench { core, link, now, .. } = &mut hands.bench;
    core.stop_compression(*now, link);
    assert_eq!(hands.dropped(0), [(DropReason::Shutdown, 1)]);
    hands.publish(ros(2, &"y".repeat(LARGE)));
    assert_eq!(hands.texts().len(), 1);
}

#[test]
fn the_oldest_gives_way_where_the_pool_is_behind() {
    let mut hands = Hands::with_pool(vec![copy(Scope::Node)], TopicInfo::default());
    for sequence in 1..=12 {
        hands.publish(ros(sequence, &"x".repeat(1024 * 1024)));
    }
    let dropped = hands.dropped(0);
    assert!(matches!(dropped[..], [(DropReason::QueueFull, 4..=6)]), "{dropped:?}");
    hands.run();
    let path = hands.bench.core.path(hands.bench.topic);
    assert_eq!(path.bridges[0].in_codec, 0);
    assert_eq!(hands.texts().len() as u64 + dropped[0].1, 12);
}

#[test]
fn late_joiners_get_what_is_kept_as_json() {
    let mut hands = Hands::new(vec![bridge(Scope::Node, to_cloud())], TopicInfo::default());
    let plain = ros(1, "a");
    let header = Header {
        depth: 1,
        encoding: plain.encoding().to_owned(),
        ..Header::new("imu/data", plain.origin(), plain.writer(), 1, WALL)
    };
    hands.publish(Frame::new(&header, plain.payload().clone()).unwrap());
    let mut durable = copy(Scope::Node);
    durable.lane.durable = true;
    hands.bench.apply(vec![durable], TopicInfo::default());
    let Bench { core, link, now, topic, .. } = &mut hands.bench;
    core.deliver_waiting(*now, *topic, link);
    assert_eq!(hands.texts(), [r#"{"data":"a"}"#]);
}
