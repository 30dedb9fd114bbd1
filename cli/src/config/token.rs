//! `blaze token`.

use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use blaze_auth::{Algorithm, Realm};
use blaze_domain::LayerName;
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::call::Call;
use super::client::Client;
use super::endpoint::{Surroundings, TokenSource, choose};
use super::kinds::BASE;
use super::options::ServerOptions;
use super::text::{age, cell, note, now_ms, parse_duration, print};
use super::token_local::{self, KeyUse, LocalToken, parse_algorithm};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Longest life of a token: a year.
const LONGEST: Duration = Duration::from_secs(31_536_000);

/// Commands of `blaze token`.
#[derive(Debug, Subcommand)]
pub enum TokenCommand {
    /// Make a token. The server signs it; with --key-file you do, without a server
    Create(CreateOptions),
    /// Tokens that the server has made, without their text
    List(ServerOptions),
    /// Take a token back: within seconds it is refused everywhere
    Revoke(RevokeOptions),
    /// What a token says; its signature is not checked
    Inspect(InspectOptions),
    /// Make a key for tokens, or for secrets
    Keygen(KeygenOptions),
}

/// Options of `blaze token create`.
#[derive(Debug, Args)]
pub struct CreateOptions {
    /// Who it is for
    #[arg(long, value_name = "SUBJECT")]
    pub subject: String,
    /// What it allows; may be repeated
    #[arg(
        long = "role",
        value_name = "ROLE",
        required = true,
        value_delimiter = ',',
        value_parser = ["viewer", "operator", "admin", "worker"]
    )]
    pub roles: Vec<String>,
    /// The only layer that it shows; needed with the role worker
    #[arg(long, value_name = "LAYER")]
    pub layer: Option<LayerName>,
    /// How long it lives, at most 365d
    #[arg(long, value_name = "DURATION", default_value = "24h", value_parser = parse_life)]
    pub expires: Duration,
    /// Who signs it.
    #[command(flatten)]
    pub signing: SigningOptions,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Who signs a token: the server, or a key of one's own.
#[derive(Debug, Clone, Args)]
pub struct SigningOptions {
    /// Sign with this key instead of asking a server
    #[arg(long, value_name = "FILE", requires = "alg", help_heading = "Without a server")]
    pub key_file: Option<PathBuf>,
    /// What the key is for: HS256, RS256 or EdDSA
    #[arg(long, value_name = "ALG", value_parser = parse_algorithm, requires = "key_file",
        help_heading = "Without a server")]
    pub alg: Option<Algorithm>,
    /// Id of the key in control_plane.auth.keys; needed where there are several
    #[arg(long, value_name = "ID", requires = "key_file", help_heading = "Without a server")]
    pub key_id: Option<String>,
    /// Issuer, as in control_plane.auth
    #[arg(long, value_name = "ISSUER", default_value = "blaze", help_heading = "Without a server")]
    pub issuer: String,
    /// Audience, as in control_plane.auth
    #[arg(
        long,
        value_name = "AUDIENCE",
        default_value = "blaze-config",
        help_heading = "Without a server"
    )]
    pub audience: String,
}

/// Options of `blaze token revoke`.
#[derive(Debug, Args)]
pub struct RevokeOptions {
    /// Id of the token: `blaze token list`
    #[arg(value_name = "ID", value_parser = parse_id)]
    pub id: String,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze token inspect`.
#[derive(Debug, Args)]
pub struct InspectOptions {
    /// File that holds the token, or - for standard input; without it the token that the other
    /// commands would send
    #[arg(value_name = "FILE|-")]
    pub file: Option<PathBuf>,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze token keygen`.
#[derive(Debug, Args)]
pub struct KeygenOptions {
    /// HS256, RS256 or EdDSA for tokens, A256GCM for secrets
    #[arg(long, value_name = "ALG")]
    pub alg: KeyUse,
    /// New file; a public part goes to the same name with .pub
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

pub(super) fn parse_life(text: &str) -> Result<Duration, String> {
    match parse_duration(text)? {
        life if (Duration::from_secs(1)..=LONGEST).contains(&life) => Ok(life),
        _ => Err("1s to 365d are allowed".to_owned()),
    }
}

fn parse_id(text: &str) -> Result<String, String> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if text.is_empty() || text.len() > 128 || !text.chars().all(allowed) || text.starts_with('.') {
        return Err(
            "an id is 1 to 128 of A-Z a-z 0-9 . _ -, as `blaze token list` shows it".to_owned()
        );
    }
    Ok(text.to_owned())
}

/// Runs one of them.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(command: &TokenCommand, format: Format) -> Result<Exit, CliError> {
    match command {
        TokenCommand::Create(options) => {
            let answer = create(options).await?;
            // The token alone, so that it can go to a file.
            print(&answer, format, |answer| {
                let token = answer.get("token").and_then(Value::as_str);
                token.unwrap_or_default().to_owned()
            })
        }
        TokenCommand::List(server) => {
            let client = Client::of(server)?;
            let answer = client.send(&Call::get(format!("{BASE}/tokens"))).await?.body;
            let items = answer
                .get("items")
                .and_then(Value::as_array)
                .ok_or_else(|| client.odd("the tokens are no list"))?;
            if items.is_empty() && format == Format::Table {
                note(format, "no token was made by the server");
                return Ok(Exit::Done);
            }
            print(&answer, format, |_| table(items, now_ms(), terminal_width()))
        }
        TokenCommand::Revoke(options) => {
            let client = Client::of(&options.server)?;
            let call = Call::delete(format!("{BASE}/tokens/{}", options.id));
            client.send(&call).await?;
            print(&json!({ "revoked": options.id }), format, |_| {
                format!("{} is revoked; it is refused everywhere within 5 s", options.id)
            })
        }
        TokenCommand::Inspect(options) => {
            let inspected = token_local::look_into(&token_of(options)?)?;
            print(&inspected, format, |inspected| token_local::description(inspected, now_ms()))
        }
        TokenCommand::Keygen(options) => {
            let made = token_local::keygen(options.alg, &options.out)?;
            print(&made, format, |made| {
                let public = made.get("public_file").and_then(Value::as_str);
                let public =
                    public.map_or_else(String::new, |file| format!(", its public part {file}"));
                format!("the key is {}{public}", options.out.display())
            })
        }
    }
}

async fn create(options: &CreateOptions) -> Result<Value, CliError> {
    if options.layer.is_none() && options.roles.iter().any(|role| role == "worker") {
        return Err(CliError::Usage("a worker's token is for one layer: give --layer".to_owned()));
    }
    let wanted = Wanted {
        subject: &options.subject,
        roles: &options.roles,
        layer: options.layer.as_ref(),
        expires: options.expires,
    };
    if let Some(signed) = options.signing.sign(&wanted)? {
        return Ok(signed);
    }
    ask_for(&Client::of(&options.server)?, &wanted).await
}

/// What a token is to say.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) subject: &'a str,
    pub(super) roles: &'a [String],
    pub(super) layer: Option<&'a LayerName>,
    pub(super) expires: Duration,
}

impl SigningOptions {
    /// Signs it here, if there is a key; the answer has the members of `POST /tokens`.
    ///
    /// # Errors
    /// As [`token_local::sign`].
    pub(super) fn sign(&self, wanted: &Wanted<'_>) -> Result<Option<Value>, CliError> {
        let (Some(key_file), Some(algorithm)) = (&self.key_file, self.alg) else {
            return Ok(None);
        };
        let token = LocalToken {
            key_file,
            algorithm,
            key_id: self.key_id.as_deref(),
            realm: Realm { issuer: self.issuer.clone(), audience: self.audience.clone() },
            subject: wanted.subject,
            roles: wanted.roles,
            layer: wanted.layer.map(LayerName::as_str),
            expires_in_s: i64::try_from(wanted.expires.as_secs()).unwrap_or(i64::MAX),
        };
        token_local::sign(&token, now_ms()).map(Some)
    }
}

/// Has the server sign a token.
///
/// # Errors
/// As [`Client::send`], and [`CliError::Foreign`] for an answer without a token.
pub(super) async fn ask_for(client: &Client, wanted: &Wanted<'_>) -> Result<Value, CliError> {
    let body = json!({
        "subject": wanted.subject, "roles": wanted.roles,
        "layer": wanted.layer.map(LayerName::as_str),
        "expires_in_s": wanted.expires.as_secs(),
    });
    let answer = client.send(&Call::post(format!("{BASE}/tokens"), &body)).await?.body;
    if answer.get("token").is_some_and(Value::is_string) {
        Ok(answer)
    } else {
        Err(client.odd("the answer has no `token`"))
    }
}

/// The token to look into.
fn token_of(options: &InspectOptions) -> Result<String, CliError> {
    if options.file.as_deref() == Some(Path::new("-")) {
        let mut text = String::new();
        // More than any token has.
        let read = std::io::stdin().lock().take(64 * 1024).read_to_string(&mut text);
        read.map_err(|error| CliError::Failed(format!("standard input: {error}")))?;
        return Ok(text.trim().to_owned());
    }
    let source = match &options.file {
        Some(file) => TokenSource::File(file.clone()),
        None => choose(&options.server, &Surroundings::of_process())?.token.ok_or_else(|| {
            CliError::Usage(
                "there is no token: name its file, or give --token-file, BLAZE_TOKEN_FILE, \
                 BLAZE_TOKEN or a context"
                    .to_owned(),
            )
        })?,
    };
    Ok(source.read()?.text().to_owned())
}

fn table(tokens: &[Value], now_ms: i64, width: Option<u16>) -> String {
    output::table(
        tokens,
        width,
        &[
            ("ID", Align::Left, &|token| cell(token.get("id"))),
            ("SUBJECT", Align::Left, &|token| cell(token.get("subject"))),
            ("ROLES", Align::Left, &|token| cell(token.get("roles"))),
            ("LAYER", Align::Left, &|token| cell(token.get("layer"))),
            ("AGE", Align::Right, &|token| age(token.get("create_time"), now_ms)),
            ("UNTIL", Align::Left, &|token| cell(token.get("expire_time"))),
            ("REVOKED", Align::Left, &|token| cell(token.get("revoke_time"))),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lives_and_ids_are_checked() {
        assert_eq!(parse_life("24h").unwrap(), Duration::from_secs(86_400));
        assert!(
            parse_life("0s").is_err() && parse_life("366d").is_err() && parse_life("x").is_err()
        );
        assert!(parse_id("0197c1d2-7f3a").is_ok());
        for bad in ["", "..", "a/b", "a b", "ä"] {
            assert!(parse_id(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn tokens_are_listed_without_their_text() {
        let tokens =
            [json!({"id": "t1", "subject": "ops", "roles": ["operator", "viewer"], "layer": null,
            "create_time": "2026-11-21T06:01:12.345Z", "expire_time": "2026-11-22T06:01:12.345Z",
            "revoke_time": null})];
        assert_eq!(
            table(&tokens, 1_795_244_472_345, None),
            "ID  SUBJECT  ROLES            LAYER  AGE  UNTIL                     REVOKED\n\
             t1  ops      operator,viewer  -       1h  2026-11-22T06:01:12.345Z  -\n"
        );
    }
}
