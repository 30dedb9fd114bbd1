//! `blaze trim`.

use clap::Args;
use serde_json::{Value, json};

use super::ask::{confirmed, must_be_possible};
use super::call::Call;
use super::client::Client;
use super::kinds::BASE;
use super::options::ServerOptions;
use super::text::{print, whole};
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Options of `blaze trim`.
#[derive(Debug, Args)]
pub struct TrimOptions {
    /// What happened before this revision is removed from the history; documents stay as they are
    #[arg(long, value_name = "R", value_parser = clap::value_parser!(u64).range(1..))]
    pub before: u64,
    /// Do not ask; needed where there is no terminal
    #[arg(short, long)]
    pub yes: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Removes old history.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &TrimOptions, format: Format) -> Result<Exit, CliError> {
    must_be_possible(options.yes)?;
    let client = Client::of(&options.server)?;
    if !options.yes && !confirmed(&question(options.before))? {
        return Err(CliError::Failed("nothing was removed".to_owned()));
    }
    let answer = send(&client, options.before).await?;
    print(&answer, format, text)
}

fn question(before: u64) -> String {
    format!(
        "What happened before revision {before} would be removed from the history for good; \
         watches that are behind it list anew.\nRemove it?"
    )
}

async fn send(client: &Client, before: u64) -> Result<Value, CliError> {
    let call = Call::post(format!("{BASE}/trim"), &json!({ "before": before }));
    let answer = client.send(&call).await?.body;
    if answer.get("oldest_revision").is_some_and(Value::is_u64) {
        Ok(answer)
    } else {
        Err(client.odd("the answer has no `oldest_revision`"))
    }
}

fn text(answer: &Value) -> String {
    let oldest = whole(answer, "oldest_revision");
    format!(
        "the history begins with revision {}; a watch can begin with --since {oldest}\n",
        oldest.saturating_add(1)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::stub::{Reply, Stub};

    #[tokio::test]
    async fn what_is_left_is_told() {
        let stub = Stub::start(|_, _| Reply::json(&json!({"oldest_revision": 399}))).await;
        let answer = send(&stub.client(), 400).await.unwrap();
        assert_eq!(stub.lines(), ["POST /api/v1/trim"]);
        assert_eq!(stub.asked()[0].json(), json!({"before": 400}));
        assert_eq!(
            text(&answer),
            "the history begins with revision 400; a watch can begin with --since 399\n"
        );
        assert!(question(400).contains("before revision 400"));
        let odd = Stub::start(|_, _| Reply::json(&json!({}))).await;
        assert!(send(&odd.client(), 400).await.is_err());
    }
}
