//! A refusal as a status of gRPC with the standard details: `ErrorInfo`, `BadRequest`, `RetryInfo`.
//!
//! Status and details travel in one header each, and some clients take no more than 8 KiB of
//! headers: what is long is cut.

use std::collections::HashMap;
use std::time::Duration;

use blaze_domain::config::{Code, FieldFault, Problem};
use tonic::Status;
use tonic_types::{ErrorDetails, FieldViolation, StatusExt as _};

/// Domain of `ErrorInfo`.
const DOMAIN: &str = "blaze";
/// Message of a status, in bytes.
const MAX_MESSAGE_BYTES: usize = 512;
/// Words about one fault, in bytes.
const MAX_FAULT_BYTES: usize = 256;
/// All faults together, in bytes before their encoding.
const MAX_FAULTS_BYTES: usize = 2048;

/// The status of a refusal.
pub(super) fn from_problem(problem: &Problem, request_id: &str) -> Status {
    let faults = violations(&problem.errors);
    let mut metadata = HashMap::from([
        ("code".to_owned(), problem.code.to_string()),
        ("applied".to_owned(), problem.applied.as_str().to_owned()),
        ("request_id".to_owned(), request_id.to_owned()),
    ]);
    let left_out = problem.errors.len() - faults.len();
    for (name, number) in [
        ("revision", problem.revision),
        ("oldest_revision", problem.oldest_revision),
        ("errors_left_out", (left_out > 0).then_some(left_out as u64)),
    ] {
        if let Some(number) = number {
            metadata.insert(name.to_owned(), number.to_string());
        }
    }
    let mut details = ErrorDetails::new();
    details.set_error_info(problem.code.as_str().to_ascii_uppercase(), DOMAIN, metadata);
    if !faults.is_empty() {
        details.set_bad_request(faults);
    }
    if let Some(seconds) = problem.retry_after_s {
        details.set_retry_info(Some(Duration::from_secs(seconds)));
    }
    let code = tonic::Code::from(problem.code.grpc_status());
    Status::with_error_details(code, cut(&problem.detail, MAX_MESSAGE_BYTES), details)
}

/// The code of a status that [`from_problem`] made; `None` for one that the library made.
pub(super) fn code_of(status: &Status) -> Option<Code> {
    let info = status.get_details_error_info()?;
    info.metadata.get("code")?.parse().ok()
}

fn violations(faults: &[FieldFault]) -> Vec<FieldViolation> {
    let mut left = MAX_FAULTS_BYTES;
    let mut out = Vec::new();
    for fault in faults {
        let mut violation = FieldViolation::new(field(fault), cut(&fault.detail, MAX_FAULT_BYTES));
        violation.reason = fault.code.as_str().to_ascii_uppercase();
        let bytes =
            violation.field.len() + violation.description.len() + violation.reason.len() + 8;
        let Some(rest) = left.checked_sub(bytes) else { break };
        left = rest;
        out.push(violation);
    }
    out
}

/// The pointer within the document; of one of several, below `/items/<index>`.
fn field(fault: &FieldFault) -> String {
    match fault.document {
        Some(index) => format!("/items/{index}{}", cut(&fault.pointer, MAX_FAULT_BYTES)),
        None => cut(&fault.pointer, MAX_FAULT_BYTES),
    }
}

fn cut(text: &str, limit: usize) -> String {
    if text.len() <= limit {
        return text.to_owned();
    }
    // The mark takes three bytes.
    format!("{}…", &text[..text.floor_char_boundary(limit.saturating_sub(3))])
}

#[cfg(test)]
mod tests {
    use blaze_domain::config::Applied;
    use proptest::prelude::*;

    use super::*;

    fn fault(document: Option<usize>, detail: &str) -> FieldFault {
        FieldFault {
            pointer: "/spec/layer".into(),
            code: Code::ReferenceNotFound,
            detail: detail.into(),
            document,
        }
    }

    #[test]
    fn every_code_comes_back() {
        for code in Code::ALL {
            let status = from_problem(&Problem::new(*code, "why"), "r1");
            assert_eq!(code_of(&status), Some(*code));
            assert_eq!(status.code() as i32, code.grpc_status());
            let info = status.get_details_error_info().unwrap();
            assert_eq!(
                (info.domain.as_str(), info.reason),
                (DOMAIN, code.as_str().to_ascii_uppercase())
            );
            assert_eq!(info.metadata["request_id"], "r1");
        }
        assert_eq!(code_of(&Status::internal("of the library")), None);
    }

    #[test]
    fn all_that_a_problem_says_is_in_the_details() {
        let mut problem =
            Problem::faults(vec![fault(None, "no layer edge"), fault(Some(2), "no layer fog")])
                .at(412)
                .retry_after(3)
                .applied(Applied::Unknown)
                .because("only for the log");
        problem.oldest_revision = Some(7);
        let status = from_problem(&problem, "r1");
        assert_eq!(status.message(), "/spec/layer: no layer edge (and 1 more)");

        let details = status.get_error_details();
        let metadata = &details.error_info().unwrap().metadata;
        for (name, value) in [
            ("code", "reference_not_found"),
            ("applied", "unknown"),
            ("revision", "412"),
            ("oldest_revision", "7"),
        ] {
            assert_eq!(metadata[name], value);
        }
        assert!(!metadata.contains_key("errors_left_out"));
        let faults = &details.bad_request().unwrap().field_violations;
        assert_eq!(faults[0].field, "/spec/layer");
        assert_eq!(faults[1].field, "/items/2/spec/layer");
        assert_eq!(
            (faults[1].description.as_str(), faults[1].reason.as_str()),
            ("no layer fog", "REFERENCE_NOT_FOUND")
        );
        assert_eq!(details.retry_info().unwrap().retry_delay, Some(Duration::from_secs(3)));
        assert!(!format!("{status:?}").contains("only for the log"));
    }

    proptest! {
        #[test]
        fn headers_stay_small_whatever_was_wrong(detail in "\\PC{0,2000}", count in 0_usize..1000) {
            let mut problem = Problem::faults(vec![fault(Some(0), &detail); count]);
            problem.detail = detail;
            let response = from_problem(&problem, "r1").into_http::<String>();
            prop_assert_eq!(&response.headers()["content-type"], "application/grpc");
            let bytes: usize =
                response.headers().iter().map(|(name, value)| name.as_str().len() + value.len())
                .sum();
            prop_assert!(bytes < 8 * 1024, "{bytes}");
        }
    }
}
