//! The task that answers calls of other flows: replies of own servers become JSON, and what cannot
//! be converted becomes a fault.

use std::sync::Arc;
use std::time::Instant;

use blaze_domain::control::{ControlError, ErrorCode};
use blaze_domain::media::{CALL_FAULT, CALL_REPLY, Media};
use blaze_domain::{Origin, TopicName, WhyCode, WriterId};
use blaze_proto::{Frame, Header};
use tokio_util::sync::CancellationToken;

use super::Shared;
use super::plane::wall_ns;
use crate::lane::calls::CallAnswer;
use crate::types::{ConvertFailure, Encoding, MessageType, Types};

/// Answers calls until the flow ends.
pub(super) async fn answer_calls(shared: Arc<Shared>, stop: CancellationToken) {
    let mut faults = Faults { writer: WriterId(rand::random()), last: 0 };
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = shared.plane.call_answers() => {}
        }
        for answer in shared.plane.read(|state| state.core.take_call_answers()) {
            let reply = match answer {
                CallAnswer::Reply(reply) => match to_json(&shared.types, reply.clone()).await {
                    Ok(reply) => Some(reply),
                    Err(failure) => {
                        let error = error_of(&failure, false);
                        reply.related().and_then(|of| {
                            faults.answer(&shared, reply.topic(), of, reply.to(), &error)
                        })
                    }
                },
                CallAnswer::Failed { request, failure } => {
                    let error = error_of(&failure, true);
                    let to = format!("{}/{}", request.origin_layer(), request.origin_node());
                    let topic = request.topic().strip_suffix("/_request").unwrap_or_default();
                    let (topic, of) =
                        (format!("{topic}/_reply"), (request.writer(), request.sequence()));
                    faults.answer(&shared, &topic, of, &to, &error)
                }
            };
            if let Some(reply) = reply {
                shared.plane.with(|state| state.answer_call(Instant::now(), reply));
            }
        }
    }
}

/// The reply of a server as JSON. Its definition may have to be read from files.
async fn to_json(types: &Arc<Types>, reply: Frame) -> Result<Frame, ConvertFailure> {
    let types = Arc::clone(types);
    let convert = move || {
        let Media::Cdr { type_name: Some(name) } = Media::of(reply.encoding()) else {
            let detail = "the reply does not name its type";
            return Err(ConvertFailure::new(WhyCode::TypeUnknown, detail));
        };
        let ty = MessageType { name, hash: reply.type_hash() };
        let json = types.get(Instant::now(), ty)?.convert(Encoding::Json, reply.payload())?;
        reply
            .recoded(CALL_REPLY, "", json.payload)
            .map_err(|error| ConvertFailure::new(WhyCode::TooLarge, error.to_string()))
    };
    let failed = |_| ConvertFailure::new(WhyCode::ConvertError, "the converter failed");
    tokio::task::spawn_blocking(convert).await.map_err(failed)?
}

/// What a caller gets to know of its request, or of the reply, that was not converted.
fn error_of(failure: &ConvertFailure, is_request: bool) -> ControlError {
    let code = match failure.code {
        WhyCode::TypeUnknown => ErrorCode::TypeUnknown,
        WhyCode::TooLarge => ErrorCode::TooLarge,
        _ => ErrorCode::ConvertError,
    };
    if is_request && code != ErrorCode::TypeUnknown {
        ControlError::new(code, format!("/request{}", failure.pointer), &*failure.detail)
    } else {
        ControlError::new(code, "/topic", failure.to_string())
    }
}

/// Faults of this flow: they go instead of replies.
struct Faults {
    writer: WriterId,
    last: u64,
}

impl Faults {
    fn answer(
        &mut self,
        shared: &Shared,
        topic: &str,
        request: (WriterId, u64),
        to: &str,
        error: &ControlError,
    ) -> Option<Frame> {
        let origin = Origin {
            layer: shared.me.layer.to_string(),
            node: shared.me.node.to_string(),
            service: server(shared, &topic.parse().ok()?),
            instance: "0".to_owned(),
            epoch: 0,
        };
        self.last += 1;
        let header = Header {
            related: Some(request),
            to: to.to_owned(),
            encoding: CALL_FAULT.to_owned(),
            reliable: true,
            ..Header::new(topic, origin, self.writer, self.last, wall_ns())
        };
        Frame::new(&header, serde_json::to_vec(error).ok()?.into()).ok()
    }
}

/// The own node that would have replied: other flows know that it may.
fn server(shared: &Shared, replies: &TopicName) -> String {
    let control = shared.control.lock();
    let entry = control.world().own().and_then(|own| own.topics.get(replies));
    let offer = entry.and_then(|entry| entry.ros2.advertise.as_ref());
    let source = offer.and_then(|offer| offer.sources.first());
    source.map_or_else(|| "ros2".to_owned(), |source| source.service.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_names_the_place_in_the_call() {
        let (convert, unknown) = (WhyCode::ConvertError, WhyCode::TypeUnknown);
        for (code, pointer, detail, is_request, expected) in [
            (convert, "/a", "found: text", true, ("convert_error", "/request/a", "found: text")),
            (convert, "", "/a: lies", true, ("convert_error", "/request", "/a: lies")),
            (unknown, "", "no a/srv/B", true, ("type_unknown", "/topic", "no a/srv/B")),
            (convert, "/sum", "short", false, ("convert_error", "/topic", "/sum: short")),
        ] {
            let pointer = pointer.to_owned();
            let failure = ConvertFailure { pointer, ..ConvertFailure::new(code, detail) };
            let error = error_of(&failure, is_request);
            assert_eq!((error.code.as_str(), &*error.pointer, &*error.detail), expected);
        }
    }
}
