//! `blaze ros2`.

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{self, Align};

#[derive(Debug, Deserialize)]
struct Ros2 {
    domain: u16,
    interface: String,
    state: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    detail: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    node: String,
    endpoints: Vec<Endpoint>,
}

#[derive(Debug, Deserialize)]
struct Endpoint {
    name: String,
    kind: String,
    #[serde(rename = "type", default, deserialize_with = "super::text_or_null")]
    type_name: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    node: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    vendor: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    owner: String,
    state: String,
    code: String,
}

pub(super) fn table(
    flow: &FlowAddress,
    value: &Value,
    width: Option<u16>,
) -> Result<String, CliError> {
    let answer: Ros2 = typed(flow, value)?;
    let Ros2 { domain, interface, state, detail, node, endpoints } = &answer;
    let mut text = heading(value);
    text.push_str(&format!("ROS 2 domain {domain} on {interface}, as {node}: {state}\n"));
    if state != "up" {
        text.push_str(&format!("{detail}\n"));
    }
    if endpoints.is_empty() {
        text.push_str(
            "No endpoints: no ROS 2 node has been found. Check ROS_DOMAIN_ID of the nodes, and \
             brokers.plugins: domain and interface.\n",
        );
        return Ok(text);
    }
    text.push_str(&output::table(
        endpoints,
        width,
        &[
            ("NAME", Align::Left, &|it| it.name.clone()),
            ("KIND", Align::Left, &|it| it.kind.clone()),
            ("TYPE", Align::Left, &|it| it.type_name.clone()),
            ("NODE", Align::Left, &|it| it.node.clone()),
            ("VENDOR", Align::Left, &|it| it.vendor.clone()),
            ("OWNER", Align::Left, &|it| it.owner.clone()),
            ("STATE", Align::Left, &|it| it.state.clone()),
            ("CODE", Align::Left, &|it| it.code.clone()),
        ],
    ));
    Ok(text)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn endpoints_are_a_table() {
        let mut value = json!({
            "flow": "edge/robot-1", "domain": 0, "interface": "127.0.0.1", "state": "up",
            "detail": "", "node": "/blaze/edge_robot_1", "participants": 1,
            "endpoints": [
                {"name": "/chatter", "kind": "publisher", "type": "std_msgs/msg/String",
                 "node": "/talker", "vendor": "fastdds", "owner": "edge/robot-1",
                 "state": "bridged", "code": "ok"},
                {"name": "/rosout", "kind": "publisher", "type": "rcl_interfaces/msg/Log",
                 "node": null, "vendor": "other", "owner": null, "state": "refused",
                 "code": "access_denied"}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert_eq!(
            table(&flow, &value, None).unwrap(),
            "flow edge/robot-1\n\
             ROS 2 domain 0 on 127.0.0.1, as /blaze/edge_robot_1: up\n\
             NAME      KIND       TYPE                    NODE     VENDOR   OWNER         STATE    CODE\n\
             /chatter  publisher  std_msgs/msg/String     /talker  fastdds  edge/robot-1  bridged  ok\n\
             /rosout   publisher  rcl_interfaces/msg/Log           other                  refused  access_denied\n"
        );
        value["endpoints"] = json!([]);
        value["state"] = json!("in_use");
        value["detail"] = json!("scope_in_use: cloud/c has it");
        let text = table(&flow, &value, None).unwrap();
        assert!(text.contains("scope_in_use") && text.contains("ROS_DOMAIN_ID"), "{text}");
    }
}
