//! The types that ROS 2 makes of a service and of an action.

use crate::description::{Field, FieldType, IndividualType};
use crate::kinds::{Base, Shape};

const EVENT_INFO: &str = "service_msgs/msg/ServiceEventInfo";
const GOAL_ID: &str = "unique_identifier_msgs/msg/UUID";
const TIME: &str = "builtin_interfaces/msg/Time";

/// A field without a default.
pub(crate) fn field(name: &str, ty: FieldType) -> Field {
    Field { name: name.to_owned(), ty, default_value: String::new() }
}

fn single(name: &str, type_name: impl Into<String>) -> Field {
    field(name, FieldType::nested(type_name, Shape::Single))
}

fn plain(name: &str, base: Base) -> Field {
    field(name, FieldType::plain(base, Shape::Single, 0))
}

fn named(type_name: String, fields: Vec<Field>) -> IndividualType {
    IndividualType { type_name, fields, constants: Vec::new() }
}

/// The service, its request, its response and its event.
pub(crate) fn service(
    name: &str,
    request: IndividualType,
    response: IndividualType,
) -> Vec<IndividualType> {
    let optional = |field_name: &str, type_name: &str| {
        field(field_name, FieldType::nested(type_name, Shape::Bounded(1)))
    };
    let event_name = format!("{name}_Event");
    let service = vec![
        single("request_message", &request.type_name),
        single("response_message", &response.type_name),
        single("event_message", &event_name),
    ];
    let event = vec![
        single("info", EVENT_INFO),
        optional("request", &request.type_name),
        optional("response", &response.type_name),
    ];
    vec![named(name.to_owned(), service), request, response, named(event_name, event)]
}

/// The action, its goal, result and feedback, both services and the message of the feedback topic.
pub(crate) fn action(
    name: &str,
    goal: IndividualType,
    result: IndividualType,
    feedback: IndividualType,
) -> Vec<IndividualType> {
    let of = |suffix: &str| format!("{name}_{suffix}");
    let action = vec![
        single("goal", &goal.type_name),
        single("result", &result.type_name),
        single("feedback", &feedback.type_name),
        single("send_goal_service", of("SendGoal")),
        single("get_result_service", of("GetResult")),
        single("feedback_message", of("FeedbackMessage")),
    ];
    let send = vec![single("goal_id", GOAL_ID), single("goal", &goal.type_name)];
    let sent = vec![plain("accepted", Base::Bool), single("stamp", TIME)];
    let get = vec![single("goal_id", GOAL_ID)];
    let got = vec![plain("status", Base::Int8), single("result", &result.type_name)];
    let message = vec![single("goal_id", GOAL_ID), single("feedback", &feedback.type_name)];
    let pair = |part: &str, request, response| {
        let request = named(of(&format!("{part}_Request")), request);
        service(&of(part), request, named(of(&format!("{part}_Response")), response))
    };
    let mut types = vec![named(name.to_owned(), action), goal, result, feedback];
    types.extend(pair("SendGoal", send, sent));
    types.extend(pair("GetResult", get, got));
    types.push(named(of("FeedbackMessage"), message));
    types
}
