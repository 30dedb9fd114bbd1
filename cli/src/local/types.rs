//! ROS 2 types for `echo` and `pub`: built in, in the folders of the node file, else asked of the
//! flow.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_convert::{Distro, Source, parse_joined};
use blaze_domain::WhyCode;
use blaze_domain::node_file::NodeFile;
use blaze_flow::types::{CompiledType, ConvertFailure, MessageType, Types, built_in_for};
use serde_json::Value;
use tokio::time::timeout;

use crate::args::FlowAddress;
use crate::http::get_json;

/// How long a flow may take to send a definition: messages wait for it.
const ANSWER_WITHIN: Duration = Duration::from_secs(3);
/// How long a flow is not asked again for a type that it did not have.
const ASK_AGAIN: Duration = Duration::from_secs(5);
/// Types without a definition that are remembered; a publisher may name any number.
const MAX_MISSING: usize = 1_024;

/// Types as a command knows them.
pub(super) struct KnownTypes {
    types: Types,
    /// Admin port of the flow, if the node file names one.
    flow: Option<FlowAddress>,
    /// Types that have no definition: when the flow was asked last.
    missing: HashMap<String, Instant>,
}

impl KnownTypes {
    /// The types of the node's ROS 2 release, else of Jazzy.
    pub(super) fn of(file: &NodeFile) -> Self {
        let ros2 = file.brokers.ros2.as_ref();
        let distro = ros2.map_or(Distro::Jazzy, |plugin| built_in_for(plugin.distro));
        let folders = ros2.map(|plugin| plugin.live.interfaces.clone());
        Self {
            types: Types::new(distro, folders.unwrap_or_default()),
            flow: admin_port(file),
            missing: HashMap::new(),
        }
    }

    /// A type by its name, `sensor_msgs/msg/Imu`.
    ///
    /// # Errors
    /// If nobody has its definition, or it cannot be converted.
    pub(super) async fn get(
        &mut self,
        now: Instant,
        name: &str,
    ) -> Result<Arc<CompiledType>, ConvertFailure> {
        let wanted = MessageType { name, hash: "" };
        let missing = match self.types.get(now, wanted) {
            Err(failure) if failure.code == WhyCode::TypeUnknown => failure,
            found => return found,
        };
        let asked = self.missing.get(name);
        if asked.is_some_and(|asked| now.saturating_duration_since(*asked) < ASK_AGAIN) {
            return Err(missing);
        }
        if self.missing.len() >= MAX_MISSING {
            self.missing.clear();
        }
        self.missing.insert(name.to_owned(), now);
        self.ask(name)
            .await
            .map_err(|reason| ConvertFailure::new(missing.code, format!("{missing}; {reason}")))?;
        self.missing.remove(name);
        self.types.get(now, wanted)
    }

    /// Gets a definition of the flow.
    async fn ask(&self, name: &str) -> Result<(), String> {
        let flow = self.flow.as_ref();
        let flow = flow.ok_or("the node file names no admin port of a flow that could have it")?;
        // Publishers may give any text.
        if !name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"/_".contains(&byte)) {
            return Err("it is no name of a type".to_owned());
        }
        let path = format!("/v1/ros2/types?type={name}");
        let answer = get_json(flow, &path);
        let answer = timeout(ANSWER_WITHIN, answer).await;
        let answer = answer.map_err(|_| format!("no answer of the flow at {flow}"))?;
        let answer = answer.map_err(|error| error.to_string())?;
        let text = answer.get("definition").and_then(Value::as_str);
        let text = text.ok_or_else(|| format!("{flow} answers without a definition"))?;
        let fault = |error: &dyn std::fmt::Display| format!("the definition of {flow}: {error}");
        let description = parse_joined(name, text, None).map_err(|error| fault(&error))?;
        self.types.add(Source::Flow, description).map_err(|error| fault(&error))
    }
}

/// Where the flow of a node file is asked, from its own host.
fn admin_port(file: &NodeFile) -> Option<FlowAddress> {
    let mut address = file.admin.flow;
    if address.ip().is_unspecified() {
        address.set_ip(IpAddr::V4(Ipv4Addr::LOCALHOST));
    }
    (address.port() != 0).then(|| FlowAddress::from(address))
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

    fn file(tree: &Value) -> NodeFile {
        NodeFile::read(tree).unwrap().0
    }

    /// A flow that has one definition; counts how often it is asked.
    fn flow(count: &Arc<AtomicUsize>) -> KnownTypes {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
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
        KnownTypes::of(&file(&json!({"admin": {"flow": address.to_string()}})))
    }

    #[tokio::test]
    async fn the_flow_is_asked_for_a_type_that_is_not_built_in() {
        let count = Arc::default();
        let mut types = flow(&count);
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
        let mut types = flow(&count);
        let now = Instant::now();
        for (after, asked) in [(0, 1), (4, 1), (5, 2)] {
            let now = now + Duration::from_secs(after);
            let failure = types.get(now, "my_robot/msg/None").await.unwrap_err();
            assert_eq!(failure.code, WhyCode::TypeUnknown);
            assert_eq!(count.load(Ordering::SeqCst), asked, "after {after} s");
        }
        let failure = types.get(now, "my_robot/msg/No one?x").await.unwrap_err();
        assert!(failure.detail.contains("no name of a type"), "{failure:?}");
        assert_eq!(count.load(Ordering::SeqCst), 2, "not asked for that");
    }

    #[test]
    fn a_flow_is_asked_on_its_own_host() {
        for (given, asked) in [
            ("0.0.0.0:9101", Some("127.0.0.1:9101")),
            ("10.0.0.1:7", Some("10.0.0.1:7")),
            ("127.0.0.1:0", None),
        ] {
            let port = admin_port(&file(&json!({"admin": {"flow": given}})));
            assert_eq!(port.map(|port| port.to_string()).as_deref(), asked);
        }
    }
}
