//! Compression on the way of a message. The test is the pool: nothing is done before it says so.

mod inward;
mod level;
mod outward;
mod property;
mod succession;

use blaze_domain::node_file::{Codec, Compression};

use super::*;
use crate::codec::pool::Urgency;
use crate::codec::{Compressed, Done, Work};
use crate::lane::compress_stage::{CodecJob, CompressionRules};

/// Worth compressing, and done in a moment.
const SMALL: usize = 2_000;
/// It makes its topic large.
const LARGE: usize = 100_000;

/// A flow, the jobs that it has requested of the pool, and what was begun.
struct Hands {
    bench: Bench,
    quick: usize,
    long: usize,
    jobs: Vec<CodecJob>,
}

/// A bridge from the node scope to another flow.
fn lane(receiver: &str, reliable: bool) -> Bridge {
    let receiver: FlowId = receiver.parse().unwrap();
    let layer = receiver.layer.clone();
    let mut lane = bridge(Scope::Node, Target::Inter { layer, receiver });
    lane.lane.reliable = reliable;
    lane
}

fn rules(level: u8, adaptive: bool) -> CompressionRules {
    CompressionRules {
        base: Compression { codec: Codec::Lz4, level, min_bytes: 1_000, adaptive },
        topics: Vec::new(),
    }
}

impl Hands {
    fn new(bridges: Vec<Bridge>) -> Self {
        let mut bench = Bench::new(bridges);
        bench.core.enable_compression();
        bench.core.set_compression(rules(1, false));
        Self { bench, quick: 0, long: 0, jobs: Vec::new() }
    }

    /// What is asked of the pool, and of the caller.
    fn look(&mut self) {
        let requests = self.bench.core.take_pool_requests();
        self.quick += requests.quick;
        self.long += requests.long;
        for _ in 0..requests.by_caller {
            self.jobs.extend(self.bench.core.begin_by_caller());
        }
    }

    fn publish(&mut self, writer: u8, sequence: u64, bytes: usize) {
        let frame = frame(writer, sequence, "robot-1", 0, bytes);
        self.bench.take(Scope::Node, vec![Content::Frame(frame)]);
        self.look();
    }

    fn publish_all(&mut self, writer: u8, sequences: std::ops::RangeInclusive<u64>, bytes: usize) {
        for sequence in sequences {
            self.publish(writer, sequence, bytes);
        }
    }

    /// A thread runs a job that was requested. `false`: nothing was left to be done.
    fn begin(&mut self, urgency: Urgency) -> bool {
        let requests = match urgency {
            Urgency::Quick => &mut self.quick,
            Urgency::Long => &mut self.long,
        };
        *requests = requests.checked_sub(1).unwrap();
        let job = self.bench.core.begin(self.bench.now, urgency, &mut self.bench.link);
        self.look();
        let has_begun = job.is_some();
        self.jobs.extend(job);
        has_begun
    }

    /// What was begun ends like this.
    fn end_with(&mut self, at: usize, done: Done) {
        let job = self.jobs.remove(at);
        self.bench.core.finished(self.bench.now, job.ticket, done, &mut self.bench.link);
        self.look();
    }

    /// It ends as the codec ends it.
    fn end(&mut self, at: usize) {
        let job = &self.jobs[at];
        let done = job.work.run(&job.payload);
        self.end_with(at, done);
    }

    /// It was compressed to so many bytes, in so many milliseconds; or goes as it is.
    fn end_as(&mut self, at: usize, after: Option<usize>, milliseconds: u64) {
        let job = &self.jobs[at];
        let Work::Compress(level) = job.work else {
            panic!("{:?}", job.work);
        };
        let time = Duration::from_millis(milliseconds);
        let done = Done::Compressed(Compressed {
            block: after.map(|bytes| Bytes::from(vec![0; bytes])),
            level,
            before: job.payload.len(),
            processor: time,
            taken: time,
        });
        self.end_with(at, done);
    }

    /// Everything is done.
    fn run(&mut self) {
        loop {
            if self.quick > 0 {
                self.begin(Urgency::Quick);
            } else if self.long > 0 {
                self.begin(Urgency::Long);
            } else if !self.jobs.is_empty() {
                self.end(0);
            } else {
                return;
            }
        }
    }

    /// The flow has another plan.
    fn plan(&mut self, bridges: Vec<Bridge>) {
        self.bench.apply(bridges, TopicInfo::default());
        self.bench.drain();
        self.look();
    }

    fn pass(&mut self, time: Duration) {
        self.bench.now += time;
        self.bench.drain();
        self.look();
    }

    /// Lane, writer and sequence of what the link got since the last call.
    fn sent(&mut self) -> Vec<(u32, u8, u64)> {
        let sent = std::mem::take(&mut self.bench.link.submitted);
        let told =
            sent.iter().map(|(lane, _, frame)| (lane.0, frame.writer().0[0], frame.sequence()));
        told.collect()
    }

    fn path(&mut self) -> &mut TopicPath {
        self.bench.core.path_mut(self.bench.topic)
    }

    fn dropped(&mut self, bridge: usize) -> Vec<(DropReason, u64)> {
        self.path().bridges[bridge].stats.dropped.iter().collect()
    }

    /// What of all bridges went to the link, was dropped or waits there is what they have taken.
    fn check(&self) {
        for bridge in &self.bench.core.path(self.bench.topic).bridges {
            let stats = &bridge.stats;
            let queued = bridge.lane_id().map_or(0, |lane| self.bench.link.queued(lane));
            let expected = stats.out.messages + stats.dropped.total() + queued;
            assert_eq!(stats.taken.messages, expected, "{:?}: {stats:?}", bridge.target);
        }
    }
}
