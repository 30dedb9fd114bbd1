//! The task that subscribes the channels of one connection, and what late joiners read first.

use std::collections::HashMap;
use std::convert::Infallible;
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use blaze_runtime::{BEAT, ticks};
use bytes::Bytes;
use redis::RedisResult;
use redis::aio::MultiplexedConnection;

use super::connection::Session;
use super::kept::read_field;
use super::publisher::unix_time_ns;
use super::state::{Failure, Line, LineState};
use super::subscriptions::{Name, Subscriptions, Work};
use super::{Shared, server};
use crate::port::{BrokerError, Content, Received};

/// How often readers are looked for that have gone.
const SWEEP: Duration = BEAT.saturating_mul(16);
/// Until what is kept for late joiners must have been read.
const READ_KEPT: Duration = Duration::from_secs(10);

/// Subscribes and unsubscribes on a connection, one command after the other, until it fails.
pub(super) async fn serve(
    shared: &Shared,
    line: Line,
    subscriptions: &Subscriptions,
    session: &Session,
) -> Result<Infallible, Failure> {
    subscriptions.forget_server();
    let mut sweeps = ticks(SWEEP);
    let mut is_up = false;
    loop {
        let Work { subscribe, unsubscribe } = subscriptions.take_work();
        if subscribe.is_empty() && unsubscribe.is_empty() {
            // All is subscribed. Whether the server still answers later is for the watch to tell.
            if !is_up {
                shared.state.set_line(line, LineState::Up);
                is_up = true;
            }
            tokio::select! {
                () = subscriptions.changed.notified() => {}
                _ = sweeps.tick() => subscriptions.sweep(),
            }
            continue;
        }
        if !unsubscribe.is_empty() {
            let mut connection = session.connection.clone();
            check(connection.unsubscribe(texts(&unsubscribe)).await)?;
        }
        if !subscribe.is_empty() {
            self::subscribe(subscriptions, session, &subscribe).await?;
        }
        session.liveness.received();
    }
}

fn texts(names: &[Name]) -> Vec<&str> {
    names.iter().map(|name| &**name).collect()
}

/// Where the access list forbids one of several, each is asked for alone.
async fn subscribe(
    subscriptions: &Subscriptions,
    session: &Session,
    names: &[Name],
) -> Result<(), Failure> {
    let mut connection = session.connection.clone();
    match connection.subscribe(texts(names)).await {
        Ok(()) => subscriptions.confirm(names),
        Err(error) if !server::is_refusal(&error) => return Err(error.into()),
        Err(error) => {
            if let [name] = names {
                tracing::warn!(channel = &**name, error = %error, "redis refuses a subscription");
                subscriptions.refuse(name, &error.to_string());
            } else {
                for name in names {
                    Box::pin(subscribe(subscriptions, session, std::slice::from_ref(name))).await?;
                }
            }
        }
    }
    Ok(())
}

/// A refusal is an answer, too.
fn check(result: RedisResult<()>) -> Result<(), Failure> {
    match result {
        Err(error) if !server::is_refusal(&error) => Err(error.into()),
        _ => Ok(()),
    }
}

/// What is kept of a channel for late joiners, in the order of publishing as far as the times tell.
pub(super) async fn read_kept(
    mut connection: MultiplexedConnection,
    hash: &str,
) -> Result<Vec<Received>, BrokerError> {
    let fields =
        server::fields(&mut connection, (hash, "what is kept for late joiners"), READ_KEPT).await?;
    Ok(kept_messages(fields, hash, unix_time_ns(), Instant::now()))
}

fn kept_messages(
    fields: Vec<(Vec<u8>, Vec<u8>)>,
    hash: &str,
    now_ns: u64,
    now: Instant,
) -> Vec<Received> {
    let mut found = Vec::new();
    let mut damaged_fields = 0;
    for (field, value) in fields {
        let writer: Option<WriterId> =
            std::str::from_utf8(&field).ok().and_then(|text| text.parse().ok());
        let Some(writer) = writer else {
            damaged_fields += 1;
            continue;
        };
        let (frames, damaged) = read_field(Bytes::from(value), writer);
        damaged_fields += usize::from(damaged);
        found.extend(frames);
    }
    if damaged_fields > 0 {
        tracing::warn!(hash, damaged_fields, "what is kept for late joiners is damaged in part");
    }
    // Stable, and the times of one writer ascend: its order stays.
    found.sort_by_key(|(written_ns, _)| *written_ns);
    let mut seen: HashMap<WriterId, u64> = HashMap::new();
    found.retain(|(_, frame)| {
        let highest = seen.entry(frame.writer()).or_insert(0);
        let newer = frame.sequence() > *highest;
        *highest = frame.sequence().max(*highest);
        newer
    });
    found
        .into_iter()
        .map(|(written_ns, frame)| {
            let age_us = now_ns.saturating_sub(written_ns) / 1_000;
            Received::kept(Content::Frame(frame), now, age_us)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::Origin;
    use blaze_proto::{Frame, Header};

    fn entry(writer: u8, sequence: u64, written_ns: u64) -> Vec<u8> {
        let header = Header::new("t", Origin::default(), WriterId([writer; 16]), sequence, 0);
        let frame = Frame::new(&header, Bytes::from_static(b"x")).unwrap().to_bytes();
        let mut bytes = u32::try_from(frame.len()).unwrap().to_le_bytes().to_vec();
        bytes.extend(written_ns.to_le_bytes());
        bytes.extend(&frame);
        bytes
    }

    #[test]
    fn kept_messages_come_in_the_order_of_their_times_and_know_their_age() {
        let field = |writer: u8| WriterId([writer; 16]).to_string().into_bytes();
        let fields = vec![
            (field(1), [entry(1, 1, 1_000), entry(1, 2, 4_000_000)].concat()),
            (
                field(2),
                [entry(2, 7, 2_000_000), entry(2, 7, 2_000_000), entry(2, 8, 5_000_000)].concat(),
            ),
            (b"no writer".to_vec(), entry(3, 1, 1)),
        ];
        let found: Vec<_> = kept_messages(fields, "h", 6_000_000, Instant::now())
            .into_iter()
            .map(|message| match message.content {
                Content::Frame(frame) => {
                    (frame.writer().0[0], frame.sequence(), message.broker_age_us)
                }
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(found, [(1, 1, 5_999), (2, 7, 4_000), (1, 2, 2_000), (2, 8, 1_000)]);
    }
}
