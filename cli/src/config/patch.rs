//! `blaze patch`.

use std::io::Read as _;

use blaze_domain::config::json;
use clap::Args;
use serde_json::Value;

use super::call::Call;
use super::client::Client;
use super::kinds::{document_path, name_of};
use super::options::{DocumentOptions, ServerOptions};
use super::text::{cell, print};
use crate::admin::closest;
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Largest patch, in bytes.
const MAX_BYTES: u64 = 1024 * 1024;
/// What a patch may change.
const MEMBERS: [&str; 3] = ["labels", "annotations", "spec"];

/// Options of `blaze patch`.
#[derive(Debug, Args)]
pub struct PatchOptions {
    /// Which document.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// What to change: JSON merge patch (RFC 7396), for example '{"spec":{"type":"mobile"}}'; null
    /// deletes a member. - reads it from standard input: best for secrets
    #[arg(short, long, value_name = "JSON|-")]
    pub patch: String,
    /// Also when somebody else changed the document in between
    #[arg(long)]
    pub force: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Patches.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &PatchOptions, format: Format) -> Result<Exit, CliError> {
    let key = options.document.key()?;
    let patch = if options.patch == "-" {
        let mut text = String::new();
        let read = std::io::stdin().lock().take(MAX_BYTES + 1).read_to_string(&mut text);
        read.map_err(|error| CliError::Failed(format!("standard input: {error}")))?;
        parse(&text)?
    } else {
        parse(&options.patch)?
    };
    let client = Client::of(&options.server)?;
    let tag = client.precondition(&key, options.force).await?;
    let call = Call::patch(document_path(&key), &patch).if_match(Some(tag));
    let document = client.send_about(&key, &call).await?.body;
    print(&document, format, |document| {
        format!("{} is at revision {}", name_of(&key), cell(document.get("revision")))
    })
}

/// Reads a patch strictly, and catches the slip of leaving `spec` out.
fn parse(text: &str) -> Result<Value, CliError> {
    if text.len() as u64 > MAX_BYTES {
        return Err(CliError::Invalid("the patch is larger than 1 MiB".to_owned()));
    }
    let patch = json::parse(text.as_bytes())
        .map_err(|fault| CliError::Invalid(format!("the patch: {fault}")))?;
    let Some(members) = patch.as_object() else {
        return Err(CliError::Invalid("the patch is no JSON object".to_owned()));
    };
    if let Some(other) = members.keys().find(|name| !MEMBERS.contains(&name.as_str())) {
        let meant = match closest(other, MEMBERS.into_iter()) {
            Some(meant) => meant.to_owned(),
            None => format!("{{\"spec\":{{\"{other}\":…}}}}"),
        };
        return Err(CliError::Invalid(format!(
            "the patch changes {other:?}; a patch changes labels, annotations and spec; did you \
             mean {meant}?"
        )));
    }
    Ok(patch)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patches_are_objects_of_what_may_be_changed() {
        for good in ["{}", r#"{"spec":{"type":null}}"#, r#"{"labels":null,"annotations":{}}"#] {
            assert!(parse(good).is_ok(), "{good}");
        }
        for (bad, why) in [
            ("[]", "no JSON object"),
            ("{", "the patch: line 1"),
            (r#"{"spec":{},"spec":{}}"#, "the patch: line 1"),
            (r#"{"label":{}}"#, "did you mean labels?"),
            (r#"{"config":{}}"#, r#"did you mean {"spec":{"config":…}}?"#),
        ] {
            let error = parse(bad).unwrap_err();
            assert_eq!(error.exit() as u8, 7);
            assert!(error.to_string().contains(why), "{bad}: {error}");
        }
    }
}
