//! ROS 2 types for `echo` and `pub`: built in, in the folders of the node file, else asked of the
//! flow.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_convert::{Distro, Source, parse_joined};
use blaze_domain::WhyCode;
use blaze_domain::node_file::NodeFile;
use blaze_flow::types::{CompiledType, ConvertFailure, MessageType, Types, built_in_for};
use serde_json::Value;
use tokio::time::timeout;

use super::publish::parse_type;
use crate::args::FlowAddress;
use crate::http::get_json;

/// How long a flow may take to send a definition: messages wait for it.
const ANSWER_WITHIN: Duration = Duration::from_secs(3);

/// Types as a command knows them.
pub(super) struct KnownTypes {
    types: Types,
    /// Admin port of the flow, if the node file names one.
    flow: Option<FlowAddress>,
}

impl KnownTypes {
    /// The types of the node's ROS 2 release, else of Jazzy.
    pub(super) fn of(file: &NodeFile) -> Self {
        let ros2 = file.brokers.ros2.as_ref();
        let distro = ros2.map_or(Distro::Jazzy, |plugin| built_in_for(plugin.distro));
        let folders = ros2.map(|plugin| plugin.live.interfaces.clone());
        let admin = file.admin.flow;
        Self {
            types: Types::new(distro, folders.unwrap_or_default()),
            flow: (admin.port() != 0).then(|| FlowAddress::from(admin)),
        }
    }

    /// A type by its name, `sensor_msgs/msg/Imu`. The flow is asked for one that is not found here,
    /// whenever it is sought anew.
    ///
    /// # Errors
    /// If nobody has its definition, or it cannot be converted.
    pub(super) async fn get(
        &self,
        now: Instant,
        name: &str,
    ) -> Result<Arc<CompiledType>, ConvertFailure> {
        let wanted = MessageType { name, hash: "" };
        if let Some(found) = self.types.known(now, wanted) {
            return found;
        }
        let missing = match self.types.get(now, wanted) {
            Err(failure) if failure.code == WhyCode::TypeUnknown => failure,
            found => return found,
        };
        self.ask(name)
            .await
            .map_err(|reason| ConvertFailure::new(missing.code, format!("{missing}; {reason}")))?;
        self.types.get(now, wanted)
    }

    /// Gets a definition of the flow.
    async fn ask(&self, name: &str) -> Result<(), String> {
        let flow = self.flow.as_ref();
        let flow = flow.ok_or("the node file names no admin port of a flow that could have it")?;
        // Publishers may give any text.
        let path = format!("/v1/ros2/types?type={}", parse_type(name)?);
        let answer = timeout(ANSWER_WITHIN, get_json(flow, &path)).await;
        let answer = answer.map_err(|_| format!("no answer of the flow at {flow}"))?;
        let answer = answer.map_err(|error| error.to_string())?;
        let text = answer.get("definition").and_then(Value::as_str);
        let text = text.ok_or_else(|| format!("{flow} answers without a definition"))?;
        let fault = |error: &dyn std::fmt::Display| format!("the definition of {flow}: {error}");
        let description = parse_joined(name, text, None).map_err(|error| fault(&error))?;
        self.types.add(Source::Flow, description).map_err(|error| fault(&error))
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::TcpListener;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use blaze_flow::types::Encoding;
    use serde_json::json;

    use super::*;

    const CUSTOM: &str = "my_robot/msg/Wheel";

    /// A flow that has one definition, and listens on all addresses; counts how often it is asked.
    fn flow(count: &Arc<AtomicUsize>) -> KnownTypes {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("0.0.0.0:{}", listener.local_addr().unwrap().port());
        let count = Arc::clone(count);
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                let mut head = vec![0; 4096];
                let length = stream.read(&mut head).unwrap();
                let head = String::from_utf8_lossy(&head[..length]).into_owned();
                count.fetch_add(1, Ordering::SeqCst);
                let (status, body) = if head.contains(&format!("?type={CUSTOM} ")) {
                    let joined = "geometry_msgs/Twist twist\nuint8 load\n\
                                  ===\nMSG: geometry_msgs/Twist\nVector3 linear\nVector3 angular\n\
                                  ===\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n";
                    (200, json!({"type": CUSTOM, "source": "node", "definition": joined}))
                } else {
                    (404, json!({"error": {"code": "type_unknown", "detail": "not here"}}))
                };
                let body = body.to_string();
                let length = body.len();
                write!(stream, "HTTP/1.1 {status} X\r\ncontent-length: {length}\r\n\r\n{body}")
                    .unwrap();
            }
        });
        KnownTypes::of(&NodeFile::read(&json!({"admin": {"flow": address}})).unwrap().0)
    }

    #[tokio::test]
    async fn the_flow_is_asked_for_a_type_that_is_not_built_in() {
        let count = Arc::default();
        let types = flow(&count);
        let now = Instant::now();
        types.get(now, "std_msgs/msg/String").await.unwrap();
        assert_eq!(count.load(Ordering::SeqCst), 0, "built in");
        for _ in 0..2 {
            let found = types.get(now, CUSTOM).await.unwrap();
            let json = br#"{"twist":{"linear":{"x":1.5}},"load":7}"#;
            assert_eq!(found.convert(Encoding::Cdr, json).unwrap().payload.len(), 4 + 49);
        }
        assert_eq!(count.load(Ordering::SeqCst), 1, "once for a type");
    }

    #[tokio::test]
    async fn a_type_that_nobody_has_is_asked_for_every_five_seconds() {
        let count = Arc::default();
        let types = flow(&count);
        let now = Instant::now();
        for (after, asked) in [(0, 1), (4, 1), (5, 2)] {
            let now = now + Duration::from_secs(after);
            let failure = types.get(now, "my_robot/msg/None").await.unwrap_err();
            assert_eq!(failure.code, WhyCode::TypeUnknown);
            assert_eq!(count.load(Ordering::SeqCst), asked, "after {after} s");
        }
        let failure = types.get(now, "my_robot/msg/No one?x").await.unwrap_err();
        assert!(failure.detail.contains("PKG/msg/NAME"), "{failure:?}");
        assert_eq!(count.load(Ordering::SeqCst), 2, "not asked for that");
    }
}
