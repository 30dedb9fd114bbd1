//! Just enough of Kafka's protocol to ask a broker whether it can be used: metadata of all topics, version 2.
//!
//! A client library would do as well, but its back-off hides when the broker came back, and the harness must also build
//! without the feature `kafka`.

use std::io::{Read as _, Write as _};
use std::time::Duration;

use anyhow::Context as _;

use super::endpoint::Endpoint;

const TIMEOUT: Duration = Duration::from_secs(1);
/// The most that an answer may hold: metadata of test topics is a few KiB.
const MAX_ANSWER: usize = 4 << 20;

const METADATA: i16 = 3;
const VERSION: i16 = 2;
const CORRELATION: i32 = 7;

/// What a broker says about itself.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Metadata {
    /// Identity of its cluster.
    pub(super) cluster: String,
    /// Brokers that take part.
    pub(super) brokers: usize,
    /// Partitions that nobody leads: writing to them fails for now.
    pub(super) leaderless: usize,
}

impl Metadata {
    /// Whether topics can be made, written and read.
    pub(super) fn is_ready(&self) -> bool {
        self.brokers > 0 && self.leaderless == 0
    }
}

/// Asks a broker.
///
/// # Errors
/// When there is no answer within a second, or one that is not Kafka's.
pub(super) fn metadata(broker: &Endpoint) -> anyhow::Result<Metadata> {
    let mut stream = broker.connect(TIMEOUT)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(&request())?;
    let mut length = [0; 4];
    stream.read_exact(&mut length)?;
    let length = usize::try_from(i32::from_be_bytes(length))?;
    anyhow::ensure!(length <= MAX_ANSWER, "an answer of {length} bytes");
    let mut answer = vec![0; length];
    stream.read_exact(&mut answer)?;
    parse(&answer)
}

fn request() -> Vec<u8> {
    let mut body = Vec::new();
    body.extend(METADATA.to_be_bytes());
    body.extend(VERSION.to_be_bytes());
    body.extend(CORRELATION.to_be_bytes());
    body.extend((-1_i16).to_be_bytes()); // no client name
    body.extend((-1_i32).to_be_bytes()); // all topics
    let mut request = i32::try_from(body.len()).unwrap_or(i32::MAX).to_be_bytes().to_vec();
    request.extend(body);
    request
}

fn parse(answer: &[u8]) -> anyhow::Result<Metadata> {
    let mut reader = Reader(answer);
    anyhow::ensure!(reader.int32()? == CORRELATION, "an answer to another question");
    let brokers = reader.length()?;
    for _ in 0..brokers {
        reader.int32()?; // node
        reader.string()?; // host
        reader.int32()?; // port
        reader.string()?; // rack
    }
    let cluster = reader.string()?.to_owned();
    reader.int32()?; // controller
    let mut leaderless = 0;
    for _ in 0..reader.length()? {
        reader.take(2)?; // error
        reader.string()?; // topic
        reader.take(1)?; // internal
        for _ in 0..reader.length()? {
            reader.take(2)?; // error
            reader.int32()?; // partition
            leaderless += usize::from(reader.int32()? < 0);
            for _ in 0..2 {
                // replicas, replicas in sync
                let nodes = reader.length()?;
                reader.take(nodes * 4)?;
            }
        }
    }
    Ok(Metadata {
        cluster,
        brokers,
        leaderless,
    })
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> anyhow::Result<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count).context("an answer that is too short")?;
        self.0 = rest;
        Ok(taken)
    }

    fn int32(&mut self) -> anyhow::Result<i32> {
        Ok(i32::from_be_bytes(self.take(4)?.try_into()?))
    }

    /// Length of an array; more than the answer has bytes is no length.
    fn length(&mut self) -> anyhow::Result<usize> {
        let length = usize::try_from(self.int32()?).context("an array of negative length")?;
        anyhow::ensure!(length <= self.0.len(), "an array longer than the answer");
        Ok(length)
    }

    /// A string; null is an empty one.
    fn string(&mut self) -> anyhow::Result<&'a str> {
        let length = i16::from_be_bytes(self.take(2)?.try_into()?);
        Ok(std::str::from_utf8(self.take(usize::try_from(length.max(0))?)?)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(leaders: &[i32]) -> Vec<u8> {
        let mut bytes = CORRELATION.to_be_bytes().to_vec();
        bytes.extend(1_i32.to_be_bytes());
        bytes.extend(1_i32.to_be_bytes());
        bytes.extend([0, 4]);
        bytes.extend(b"host");
        bytes.extend(9092_i32.to_be_bytes());
        bytes.extend((-1_i16).to_be_bytes());
        bytes.extend([0, 2, b'i', b'd']);
        bytes.extend(1_i32.to_be_bytes());
        bytes.extend(1_i32.to_be_bytes());
        bytes.extend([0, 0, 0, 1, b't', 0]);
        bytes.extend(i32::try_from(leaders.len()).unwrap().to_be_bytes());
        for leader in leaders {
            bytes.extend([0, 0, 0, 0, 0, 0]);
            bytes.extend(leader.to_be_bytes());
            bytes.extend([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0]);
        }
        bytes
    }

    #[test]
    fn a_broker_is_ready_when_every_partition_has_a_leader() {
        let metadata = parse(&answer(&[1, 1])).unwrap();
        assert_eq!(
            metadata,
            Metadata {
                cluster: "id".to_owned(),
                brokers: 1,
                leaderless: 0
            }
        );
        assert!(metadata.is_ready());
        assert!(!parse(&answer(&[1, -1])).unwrap().is_ready());
    }

    #[test]
    fn an_answer_cut_anywhere_is_an_error() {
        let whole = answer(&[1, -1]);
        for length in 0..whole.len() {
            assert!(parse(&whole[..length]).is_err(), "{length} of {} bytes", whole.len());
        }
    }
}
