//! Type descriptions that come as messages: request and response of a node's
//! `get_type_description`.

use serde::Deserialize;
use serde_json::json;

use crate::built_in::{Distro, built_in};
use crate::description::{DescriptionError, TypeDescription, at_most};
use crate::limits::MAX_DEFINITION_BYTES;
use crate::program::Program;

const DESCRIPTION: &str = "type_description_interfaces/msg/TypeDescription";
const REQUEST: &str = "type_description_interfaces/srv/GetTypeDescription_Request";
const RESPONSE: &str = "type_description_interfaces/srv/GetTypeDescription_Response";

/// The members that are needed.
#[derive(Deserialize)]
struct Response {
    successful: bool,
    failure_reason: String,
    type_description: TypeDescription,
}

impl TypeDescription {
    /// CDR of `type_description_interfaces/srv/GetTypeDescription_Request`, which asks for a type
    /// without the text of its files.
    ///
    /// # Errors
    /// For texts that CDR cannot have, such as one with NUL.
    pub fn request(type_name: &str, hash: &str) -> Result<Vec<u8>, DescriptionError> {
        let request =
            json!({"type_name": type_name, "type_hash": hash, "include_type_sources": false});
        let mut cdr = Vec::new();
        let written = program(REQUEST)?.to_cdr(request.to_string().as_bytes(), &mut cdr);
        written.map_err(|error| DescriptionError::Syntax(error.to_string()))?;
        Ok(cdr)
    }

    /// Reads CDR of `type_description_interfaces/msg/TypeDescription`.
    ///
    /// # Errors
    /// For bytes of another type, names that are none, and more than the limits allow.
    pub fn from_cdr(cdr: &[u8]) -> Result<Self, DescriptionError> {
        Self::from_json(&json(DESCRIPTION, cdr)?)
    }

    /// Reads CDR of `type_description_interfaces/srv/GetTypeDescription_Response`.
    ///
    /// # Errors
    /// As [`TypeDescription::from_cdr`], and for a response without a description.
    pub fn from_response(cdr: &[u8]) -> Result<Self, DescriptionError> {
        let response: Response = serde_json::from_slice(&json(RESPONSE, cdr)?)
            .map_err(|error| DescriptionError::Syntax(error.to_string()))?;
        if !response.successful {
            return Err(DescriptionError::Refused(response.failure_reason));
        }
        response.type_description.checked()
    }
}

/// The definition of the message is our own, whatever release the node is of: all are the same.
fn program(type_name: &str) -> Result<Program, DescriptionError> {
    let fault = |text: String| DescriptionError::Syntax(text);
    let description = built_in(Distro::Jazzy).describe(type_name);
    let description = description.map_err(|error| fault(error.to_string()))?;
    Program::compile(&description).map_err(|error| fault(error.to_string()))
}

fn json(type_name: &str, cdr: &[u8]) -> Result<Vec<u8>, DescriptionError> {
    at_most("bytes", cdr.len(), MAX_DEFINITION_BYTES)?;
    let mut json = Vec::new();
    let read = program(type_name)?.to_json(cdr, &mut json);
    read.map_err(|error| DescriptionError::Syntax(error.to_string()))?;
    Ok(json)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cdr(type_name: &str, json: &str) -> Vec<u8> {
        let description = built_in(Distro::Kilted).describe(type_name).expect("it is built in");
        let program = Program::compile(&description).expect("it can be converted");
        let mut cdr = Vec::new();
        program.to_cdr(json.as_bytes(), &mut cdr).expect("a message");
        cdr
    }

    #[test]
    fn responses_of_nodes_are_read() {
        let twist = built_in(Distro::Jazzy).describe("geometry_msgs/msg/Twist").expect("built in");
        let json = serde_json::to_string(&twist).expect("JSON");
        assert_eq!(TypeDescription::from_cdr(&cdr(DESCRIPTION, &json)), Ok(twist.clone()));
        let response = format!(r#"{{"successful":true,"type_description":{json}}}"#);
        assert_eq!(TypeDescription::from_response(&cdr(RESPONSE, &response)), Ok(twist));
    }

    #[test]
    fn a_request_names_the_type_and_its_hash() {
        let request = TypeDescription::request("a/msg/B", "RIHS01_00").expect("a request");
        let mut json = Vec::new();
        program(REQUEST).expect("built in").to_json(&request, &mut json).expect("it is one");
        assert_eq!(
            String::from_utf8_lossy(&json),
            r#"{"type_name":"a/msg/B","type_hash":"RIHS01_00","include_type_sources":false}"#
        );
        assert!(TypeDescription::request("a\0b", "").is_err());
    }

    #[test]
    fn a_node_may_have_no_description() {
        let response = cdr(RESPONSE, r#"{"failure_reason":"no such type"}"#);
        let error = TypeDescription::from_response(&response).expect_err("none");
        assert_eq!(error.to_string(), "the node has no description: no such type");
        let response = cdr(RESPONSE, r#"{"successful":true}"#);
        assert_eq!(
            TypeDescription::from_response(&response),
            Err(DescriptionError::TypeName(String::new()))
        );
        assert!(TypeDescription::from_response(&[0, 1, 0, 0, 1]).is_err());
        let error = TypeDescription::from_response(&vec![0; MAX_DEFINITION_BYTES + 1]);
        assert!(error.expect_err("too large").to_string().contains("1048577 bytes"));
    }
}
