//! What ROS 2 nodes and RustDDS make of one another: the facts that the ROS 2 adapter is built on.
//!
//! ```text
//! ros2_peers DOMAIN echo SECONDS      rt/big -> rt/big_reply, as raw CDR; gaps, doubles, what the kernel dropped
//! ros2_peers DOMAIN late SECONDS      joins rt/counter as a reliable, volatile reader; the first and last sample, gaps
//! ros2_peers DOMAIN serve SECONDS     answers rq/basic_typesRequest, with the identity of the request in the reply
//! ros2_peers DOMAIN call COUNT        calls rq/basic_typesRequest and looks for its identity in the replies
//! ros2_peers DOMAIN gone COUNT         has a server of /basic_types for a second, and none for two, COUNT times
//! ros2_peers DOMAIN watch SECONDS     prints the endpoints of others
//! ros2_peers DOMAIN adapter SECONDS   rt/big -> rt/big_reply through the adapter, and prints what it knows of others
//! ```
//!
//! All on 127.0.0.1. Figures of runs against Fast DDS and Cyclone: `docs/design/ros2.md`.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use blaze_brokers::dds::{
    Cdr, DdsError, Participant, ParticipantConfig, Profile, Reader, Sample, TimingQos, Writer,
    Written,
};
use blaze_brokers::ros2::{GidLength, Ros2Broker, Ros2Config};
use blaze_brokers::{Broker as _, Content, Health, Publisher, PublisherOptions, SubscribeOptions};
use bytes::{BufMut, BytesMut};
use rustdds::WriteOptionsBuilder;
use rustdds::rpc::SampleIdentity;

const BIG: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
const COUNTER: &str = "std_msgs::msg::dds_::UInt64_";
const REQUEST: &str = "test_msgs::srv::dds_::BasicTypes_Request_";
const REPLY: &str = "test_msgs::srv::dds_::BasicTypes_Response_";

type Error = Box<dyn std::error::Error>;

fn main() -> Result<(), Error> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [domain, task, count] = &arguments[..] else {
        return Err("usage: ros2_peers DOMAIN echo|late|serve|call|gone|watch SECONDS|COUNT".into());
    };
    if task == "adapter" {
        let runtime = tokio::runtime::Runtime::new()?;
        return runtime.block_on(adapter(domain.parse()?, Duration::from_secs(count.parse()?)));
    }
    let mut config = ParticipantConfig::new(domain.parse()?, Ipv4Addr::LOCALHOST);
    config.largest_sample = 16 << 20;
    config.repairs_fragments = true;
    config.any_vendor = true;
    config.send_buffer_bytes = 4 << 20;
    let participant = Participant::start(config)?;
    let count = count.parse()?;
    match task.as_str() {
        "echo" => echo(&participant, Duration::from_secs(count))?,
        "late" => late(&participant, Duration::from_secs(count))?,
        "serve" => serve(&participant, Duration::from_secs(count))?,
        "call" => call(&participant, count)?,
        "gone" => gone(&participant, count)?,
        "watch" => watch(&participant, Duration::from_secs(count))?,
        other => return Err(format!("unknown task {other}").into()),
    }
    println!("dropped by the kernel: {}", participant.dropped_by_kernel());
    Ok(())
}

fn reliable(depth: u16) -> Profile {
    Profile { reliable: true, window: 64, timing: TimingQos::MARKED, ..Profile::best_effort(depth) }
}

/// A reader whose samples come out of a queue.
fn read(
    participant: &Participant,
    topic: (&str, &str),
    profile: Profile,
) -> Result<(Reader, Receiver<Sample>), DdsError> {
    let (sender, receiver): (SyncSender<Sample>, _) = sync_channel(4096);
    let sink = Box::new(move |sample| sender.send(sample).is_ok());
    Ok((participant.typed_reader(topic, profile, sink)?, receiver))
}

fn write(writer: &Writer, cdr: &Cdr, related: Option<SampleIdentity>) -> Option<i64> {
    let until = Instant::now() + Duration::from_secs(2);
    while Instant::now() < until {
        let options = WriteOptionsBuilder::new().related_sample_identity_opt(related);
        match writer.write_cdr(cdr.clone(), options) {
            Written::Taken(sequence) => return Some(sequence),
            Written::NoReader | Written::Full => std::thread::sleep(Duration::from_millis(1)),
            Written::Failed => return None,
        }
    }
    None
}

/// Sequence numbers of one writer: what is missing, and what came again.
#[derive(Default)]
struct Numbers {
    first: i64,
    last: i64,
    count: u64,
    missing: i64,
    again: u64,
}

impl Numbers {
    fn note(&mut self, sequence: i64) {
        self.count += 1;
        if self.first == 0 {
            self.first = sequence;
        } else if sequence <= self.last {
            self.again += 1;
        } else {
            self.missing += sequence - self.last - 1;
        }
        self.last = self.last.max(sequence);
    }

    fn print(&self) {
        let Self { first, last, count, missing, again } = self;
        println!("{count} samples, {first} to {last}, {missing} missing, {again} again");
    }
}

fn echo(participant: &Participant, time: Duration) -> Result<(), Error> {
    let (_reader, samples) = read(participant, ("rt/big", BIG), reliable(16))?;
    let writer = participant.typed_writer(("rt/big_reply", BIG), reliable(16))?;
    let (mut numbers, mut bytes, mut unsent) = (Numbers::default(), 0, 0);
    let until = Instant::now() + time;
    while let Ok(sample) = samples.recv_timeout(until.saturating_duration_since(Instant::now())) {
        numbers.note(sample.sequence_number.into());
        bytes += sample.sample.payload().len();
        if write(&writer, &sample.sample, None).is_none() {
            unsent += 1;
        }
    }
    numbers.print();
    println!("{bytes} bytes, {unsent} replies not taken");
    Ok(())
}

fn late(participant: &Participant, time: Duration) -> Result<(), Error> {
    // The participants have met: what is left is how long the endpoints take.
    std::thread::sleep(Duration::from_secs(3));
    let begin = Instant::now();
    let (_reader, samples) = read(participant, ("rt/counter", COUNTER), reliable(4096))?;
    let mut numbers = Numbers::default();
    let mut first = None;
    while let Ok(sample) = samples.recv_timeout(time.saturating_sub(begin.elapsed())) {
        first.get_or_insert_with(|| begin.elapsed());
        numbers.note(sample.sequence_number.into());
    }
    println!("first sample after {first:?}");
    numbers.print();
    Ok(())
}

fn serve(participant: &Participant, time: Duration) -> Result<(), Error> {
    let request = ("rq/basic_typesRequest", REQUEST);
    let (_reader, samples) = read(participant, request, reliable(64))?;
    let writer = participant.typed_writer(("rr/basic_typesReply", REPLY), reliable(64))?;
    let mut served = 0;
    let until = Instant::now() + time;
    while let Ok(sample) = samples.recv_timeout(until.saturating_duration_since(Instant::now())) {
        // Fast DDS looks for the identity of its reader of replies, if the request names that, with
        // the number of the request.
        let reader = sample.related_sample_identity().map(|related| related.writer_guid);
        let identity = SampleIdentity {
            writer_guid: reader.unwrap_or(sample.writer_guid),
            sequence_number: sample.sequence_number,
        };
        if write(&writer, &sample.sample, Some(identity)).is_some() {
            served += 1;
        }
    }
    println!("{served} requests answered");
    Ok(())
}

/// A server whose coming and going clients see (`service_is_ready`).
fn gone(participant: &Participant, count: u64) -> Result<(), Error> {
    for _ in 0..count {
        let reader = read(participant, ("rq/basic_typesRequest", REQUEST), reliable(64))?;
        let writer = participant.typed_writer(("rr/basic_typesReply", REPLY), reliable(64))?;
        println!("{:.3} there", now_seconds());
        std::thread::sleep(Duration::from_secs(1));
        drop((reader, writer));
        println!("{:.3} gone", now_seconds());
        std::thread::sleep(Duration::from_secs(2));
    }
    Ok(())
}

fn now_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

fn call(participant: &Participant, count: u64) -> Result<(), Error> {
    let reply = ("rr/basic_typesReply", REPLY);
    let (_reader, samples) = read(participant, reply, reliable(64))?;
    let request = ("rq/basic_typesRequest", REQUEST);
    let writer = participant.typed_writer(request, reliable(64))?;
    // One member of each kind: a request and a reply of test_msgs/srv/BasicTypes end in a string.
    let mut cdr = BytesMut::from(&[0, 1, 0, 0][..]);
    cdr.put_bytes(0, 48);
    cdr.put_u32_le(6);
    cdr.put_slice(b"hello\0");
    let cdr = Cdr::little(cdr.freeze()).ok_or("no CDR")?;
    let (mut waiting, mut answered, mut strangers) = (HashMap::new(), 0_u64, 0_u64);
    for number in 0..count {
        let sent = write(&writer, &cdr, None).ok_or("no server takes it")?;
        waiting.insert(sent, number);
        while let Ok(sample) = samples.recv_timeout(Duration::from_secs(3)) {
            let related = sample.related_sample_identity();
            let ours = related.filter(|it| it.writer_guid.to_bytes() == writer.id());
            match ours.and_then(|it| waiting.remove(&i64::from(it.sequence_number))) {
                Some(_) => answered += 1,
                None => strangers += 1,
            }
            if waiting.is_empty() {
                break;
            }
        }
    }
    println!("{answered} of {count} answered, {strangers} replies to others");
    Ok(())
}

fn watch(participant: &Participant, time: Duration) -> Result<(), Error> {
    let (sender, found) = sync_channel(64);
    let _watch = participant.watch_endpoints("r", Box::new(move |it| drop(sender.send(it))))?;
    let (_reader, _samples) = read(participant, ("rt/marked", COUNTER), reliable(1))?;
    let _writer = participant.typed_writer(("rt/marked", COUNTER), reliable(1))?;
    let until = Instant::now() + time;
    let mut all = [HashMap::new(), HashMap::new()];
    while let Ok(endpoints) = found.recv_timeout(until.saturating_duration_since(Instant::now())) {
        for (all, found) in all.iter_mut().zip([endpoints.writers, endpoints.readers]) {
            all.extend(found.into_iter().map(|it| (it.id, it)));
        }
    }
    for (kind, all) in ["writer", "reader"].into_iter().zip(all) {
        for it in all.into_values() {
            let says = String::from_utf8_lossy(&it.user_data).into_owned();
            println!(
                "{kind} {} {} reliable={} durable={} marked={} deadline={:?} liveliness={:?} \
                 sockets={:?} user_data={says:?}",
                it.topic,
                it.type_name,
                it.is_reliable(),
                it.is_durable(),
                it.is_marked(),
                it.qos.deadline(),
                it.qos.liveliness(),
                it.sockets,
            );
        }
    }
    Ok(())
}

/// Echoes what owned writers publish, through the adapter.
async fn adapter(domain: u16, time: Duration) -> Result<(), Error> {
    let network = Ros2Broker::open(Ros2Config {
        flow: "edge/robot-1".parse()?,
        domain,
        interface: Ipv4Addr::LOCALHOST,
        namespace: String::new(),
        peers: Vec::new(),
        gid: GidLength::Short,
    })?;
    let until = tokio::time::Instant::now() + time;
    let mut status = network.status();
    status.wait_for(|status| status.health == Health::Up).await?;
    let publisher = |depth| -> Result<Arc<dyn Publisher>, Error> {
        let options = PublisherOptions { reliable: true, large: true, depth };
        Ok(network.publisher(&"big_reply".parse()?, options)?)
    };
    let mut publishers = HashMap::<u32, Arc<dyn Publisher>>::new();
    let ask = SubscribeOptions { large: true, with_kept: true, ..SubscribeOptions::default() };
    let mut subscription = network.subscribe(&"big".parse()?, ask).await?;
    let mut found = network.network();
    let mut numbers = HashMap::<_, Numbers>::new();
    let mut batch = Vec::new();
    loop {
        tokio::select! {
            () = tokio::time::sleep_until(until) => break,
            _ = found.changed() => {
                let endpoints = Arc::clone(&found.borrow_and_update());
                let writers = endpoints.endpoints.iter().filter(|it| it.is_writer);
                network.set_owned(writers.map(|it| (it.id, true)).collect());
            }
            _ = subscription.receive(&mut batch, 64) => {
                for received in batch.drain(..) {
                    let Content::Frame(frame) = received.content else { continue };
                    let numbers = numbers.entry(frame.origin_service().to_owned()).or_default();
                    numbers.note(i64::try_from(frame.sequence())?);
                    let depth = frame.depth();
                    if let Entry::Vacant(vacant) = publishers.entry(depth) {
                        vacant.insert(publisher(depth)?);
                    }
                    publishers[&depth].publish(&frame, None);
                }
            }
        }
    }
    for it in &network.network().borrow().endpoints {
        let node = it.node.as_deref().unwrap_or("?");
        println!("{} {} of {node} ({})", it.name, it.dds_type, it.vendor.as_str());
    }
    for (service, numbers) in numbers {
        print!("{service}: ");
        numbers.print();
    }
    println!("{:?}, lost {}", network.counts(), subscription.take_dropped());
    for (depth, publisher) in publishers {
        println!("depth {depth}: {:?}", publisher.later());
    }
    network.close().await;
    Ok(())
}
