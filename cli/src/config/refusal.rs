//! What the server refused with, as people read it: what was wrong, where, what to do.

use std::fmt;

use serde_json::{Value, json};

use super::text::{member, printable, printable_lines};
use crate::exit::Exit;

/// Faults that are listed; more help nobody.
const MAX_FAULTS: usize = 20;
/// Of an answer that is no problem object, so many characters are shown.
const MAX_FOREIGN: usize = 300;

/// A refusal of the main service.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// Who refused.
    pub server: String,
    /// Status of HTTP; 0 for one within a stream.
    pub status: u16,
    /// The problem object (RFC 9457), or one of the same form where something else answered.
    pub problem: Value,
    /// Where the documents of the request come from, in their order: `robot.yaml:12 (document 2)`.
    pub sources: Vec<String>,
    /// What to do, one sentence each.
    pub hints: Vec<String>,
}

impl Refusal {
    /// Reads the body of an answer that is no success.
    #[must_use]
    pub fn read(server: &str, status: u16, body: &[u8]) -> Self {
        let problem = match serde_json::from_slice(body) {
            Ok(Value::Object(problem)) if problem.contains_key("code") => Value::Object(problem),
            _ => foreign(status, body),
        };
        Self::of(server, status, problem)
    }

    /// A problem that came within a stream.
    #[must_use]
    pub fn of(server: &str, status: u16, problem: Value) -> Self {
        Self { server: server.to_owned(), status, problem, sources: Vec::new(), hints: Vec::new() }
    }

    /// The error code; empty where it was not BlazeConfig that answered.
    #[must_use]
    pub fn code(&self) -> &str {
        self.problem.get("code").and_then(Value::as_str).unwrap_or_default()
    }

    /// A member that is a number.
    #[must_use]
    pub fn number(&self, name: &str) -> Option<u64> {
        self.problem.get(name).and_then(Value::as_u64)
    }

    /// The exit code for it.
    #[must_use]
    pub fn exit(&self) -> Exit {
        let told = self.problem.get("status").and_then(Value::as_u64);
        let status = match self.status {
            0 => told.and_then(|status| u16::try_from(status).ok()).unwrap_or_default(),
            status => status,
        };
        Exit::of_status(status)
    }

    /// Says where the documents of the request come from: in the text, and as `source` in the
    /// problem's errors.
    #[must_use]
    pub fn with_sources(mut self, sources: Vec<String>) -> Self {
        if let Some(Value::Array(errors)) = self.problem.get_mut("errors") {
            for error in errors {
                let source = document_of(error).and_then(|index| sources.get(index)).cloned();
                if let (Some(members), Some(source)) = (error.as_object_mut(), source) {
                    members.insert("source".to_owned(), source.into());
                }
            }
        }
        self.sources = sources;
        self
    }

    /// With one more thing to do, before all that are said by the code alone.
    #[must_use]
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hints.push(hint.into());
        self
    }

    /// What is to be done about a code, wherever it comes from.
    fn advice(&self) -> Option<String> {
        let after = |default: &str| match self.number("retry_after_s") {
            Some(seconds) => format!("try again in {seconds} s"),
            None => default.to_owned(),
        };
        let now = self.number("revision");
        match self.code() {
            "permission_denied" => {
                Some("the token's roles or layer do not allow it: `blaze token inspect`".to_owned())
            }
            "precondition_failed" | "revision_conflict" => Some(match now {
                Some(revision) => {
                    format!(
                        "it was changed in between and is at revision {revision} now: look, then \
                         try again"
                    )
                }
                None => "it was changed in between: look, then try again".to_owned(),
            }),
            "revision_trimmed" => self.number("oldest_revision").map(|oldest| {
                format!("what is kept of the history begins after revision {oldest}")
            }),
            "signing_disabled" => Some("sign it yourself: --key-file FILE --alg ALG".to_owned()),
            "rollout_active" => {
                Some("`blaze get rollouts` shows it; promote or abort it first".to_owned())
            }
            "rate_limited" | "overloaded" => Some(after("try again later")),
            "store_unavailable" | "shutting_down" => {
                Some(format!("nothing was changed; {}", after("try again later")))
            }
            _ => None,
        }
    }
}

fn document_of(error: &Value) -> Option<usize> {
    usize::try_from(error.get("document")?.as_u64()?).ok()
}

/// A problem object for an answer that holds none: a proxy in between, or another program.
fn foreign(status: u16, body: &[u8]) -> Value {
    let shown: String = String::from_utf8_lossy(body).trim().chars().take(MAX_FOREIGN).collect();
    json!({
        "type": "about:blank",
        "title": "Something between, or another program, answered.",
        "status": status,
        "detail": format!(
            "HTTP status {status} without a problem of BlazeConfig: {}",
            printable(&shown),
        ),
    })
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let empty = Vec::new();
        let errors = self.problem.get("errors").and_then(Value::as_array).unwrap_or(&empty);
        // With a list of faults the detail only repeats the first.
        let words = match (errors.is_empty(), self.problem.get("detail").and_then(Value::as_str)) {
            (true, Some(detail)) if !detail.is_empty() => printable_lines(detail),
            _ => member(&self.problem, "title"),
        };
        match self.code() {
            "" => write!(f, "{} answered: {words}", self.server)?,
            code => write!(f, "{}: {words}", printable(code))?,
        }
        for error in errors.iter().take(MAX_FAULTS) {
            write!(f, "\n  {}", self.fault_line(error))?;
        }
        if errors.len() > MAX_FAULTS {
            write!(f, "\n  and {} more", errors.len() - MAX_FAULTS)?;
        }
        for hint in self.hints.iter().cloned().chain(self.advice()) {
            write!(f, "\n  {hint}")?;
        }
        if self.problem.get("applied").and_then(Value::as_str) == Some("unknown") {
            f.write_str(
                "\n  Whether the change took effect is not known: look before you try again.",
            )?;
        }
        let page = member(&self.problem, "type");
        if page.starts_with('/') {
            write!(f, "\n  See {}{page}", self.server)?;
            let request = member(&self.problem, "request_id");
            if !request.is_empty() {
                write!(f, " (request {request})")?;
            }
        }
        Ok(())
    }
}

impl Refusal {
    fn fault_line(&self, error: &Value) -> String {
        let mut line = String::new();
        let index = document_of(error);
        match (index.and_then(|index| self.sources.get(index)), index) {
            (Some(source), _) => line.push_str(&format!("{source}: ")),
            // One document alone needs no number.
            (None, Some(index)) if self.sources.is_empty() && index > 0 => {
                line.push_str(&format!("document {}: ", index + 1));
            }
            (None, _) => {}
        }
        let pointer = member(error, "pointer");
        if !pointer.is_empty() {
            line.push_str(&format!("{pointer}: "));
        }
        line.push_str(&member(error, "detail"));
        let code = member(error, "code");
        if !code.is_empty() && code != self.code() {
            line.push_str(&format!(" ({code})"));
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SERVER: &str = "http://127.0.0.1:8080";

    fn refusal(status: u16, problem: &Value) -> Refusal {
        Refusal::read(SERVER, status, problem.to_string().as_bytes())
    }

    #[test]
    fn a_refusal_says_what_where_and_what_to_do() {
        let refusal = refusal(
            412,
            &json!({"type": "/docs/errors/precondition_failed", "title": "The document has another \
                revision.", "status": 412,
                "detail": "Node/robot-1 is at revision 420", "instance": "/api/v1/nodes/robot-1",
                "code": "precondition_failed",
                "request_id": "r-1", "applied": "no", "revision": 420}),
        );
        assert_eq!(refusal.exit(), Exit::Conflict);
        assert_eq!(
            refusal.to_string(),
            "precondition_failed: Node/robot-1 is at revision 420\n\
             \x20 it was changed in between and is at revision 420 now: look, then try again\n\
             \x20 See http://127.0.0.1:8080/docs/errors/precondition_failed (request r-1)"
        );
    }

    #[test]
    fn faults_are_listed_with_file_and_line() {
        let problem = json!({"type": "/docs/errors/reference_not_found", "title": "A document that \
            is referred to does not exist.",
            "status": 422, "detail": "/spec/layer: no layer edgee (and 1 more)",
            "code": "reference_not_found", "applied": "no",
            "errors": [
                {
                    "pointer": "/spec/layer",
                    "code": "reference_not_found",
                    "detail": "no layer edgee",
                    "document": 1,
                },
                {
                    "pointer": "/spec/type",
                    "code": "validation_failed",
                    "detail": "is not static, gateway or mobile",
                    "document": 0,
                },
                {"pointer": "", "code": "validation_failed", "detail": "x", "document": 9}]});
        let refusal = refusal(422, &problem)
            .with_sources(vec!["a.yaml:1".to_owned(), "a.yaml:7 (document 2)".to_owned()]);
        assert_eq!(refusal.exit(), Exit::Invalid);
        assert_eq!(
            refusal.to_string(),
            "reference_not_found: A document that is referred to does not exist.\n\
             \x20 a.yaml:7 (document 2): /spec/layer: no layer edgee\n\
             \x20 a.yaml:1: /spec/type: is not static, gateway or mobile (validation_failed)\n\
             \x20 x (validation_failed)\n\
             \x20 See http://127.0.0.1:8080/docs/errors/reference_not_found"
        );
        assert_eq!(refusal.problem["errors"][0]["source"], "a.yaml:7 (document 2)");
        assert!(refusal.problem["errors"][2].get("source").is_none());
    }

    #[test]
    fn an_unknown_outcome_says_so() {
        let problem = json!({
            "code": "outcome_unknown",
            "title": "t",
            "detail": "d",
            "status": 503,
            "applied": "unknown",
        });
        let refusal = refusal(503, &problem);
        assert_eq!(refusal.exit(), Exit::Failed);
        assert!(refusal.to_string().contains("look before you try again"), "{refusal}");
    }

    #[test]
    fn something_else_that_answers_is_shown_harmlessly() {
        let refusal = Refusal::read(SERVER, 502, b"<html>\x1b[2JBad Gateway</html>");
        assert_eq!((refusal.code(), refusal.exit()), ("", Exit::Failed));
        let text = refusal.to_string();
        assert!(
            text.starts_with(SERVER) && text.contains("Bad Gateway") && !text.contains('\u{1b}'),
            "{text}"
        );
        // JSON of another program is no problem object.
        let other = Refusal::read(SERVER, 404, br#"{"error":"x"}"#);
        assert_eq!((other.code(), other.exit()), ("", Exit::NotFound));
    }

    #[test]
    fn many_faults_are_cut() {
        let errors: Vec<Value> =
            (0..30).map(|n| json!({"pointer": format!("/{n}"), "detail": "x"})).collect();
        let problem =
            json!({"code": "validation_failed", "title": "t", "detail": "d", "errors": errors});
        assert!(refusal(422, &problem).to_string().contains("\n  and 10 more"));
    }

    #[test]
    fn a_problem_in_a_stream_has_its_own_status() {
        let problem =
            json!({"code": "unauthenticated", "title": "t", "detail": "d", "status": 401});
        assert_eq!(Refusal::of(SERVER, 0, problem).exit(), Exit::NotAllowed);
        let slow = json!({"code": "watch_too_slow", "title": "t", "detail": "d"});
        assert_eq!(Refusal::of(SERVER, 0, slow).exit(), Exit::Failed);
    }
}
