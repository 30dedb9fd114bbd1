//! What can be done with tokens without a server: sign, look into, make keys. The work is that of
//! `blaze-auth`, which the server has too: what is signed here is taken there.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use blaze_auth::{
    Algorithm, NewToken, Realm, generate_encryption_key, generate_key, inspect, random_id,
    sign_locally,
};
use blaze_domain::config::Timestamp;
use serde_json::{Value, json};

use super::files::small;
use super::text::printable;
use crate::exit::CliError;

/// A token that is to be signed here.
#[derive(Debug)]
pub(super) struct LocalToken<'a> {
    pub(super) key_file: &'a Path,
    pub(super) algorithm: Algorithm,
    pub(super) key_id: Option<&'a str>,
    pub(super) realm: Realm,
    pub(super) subject: &'a str,
    pub(super) roles: &'a [String],
    pub(super) layer: Option<&'a str>,
    pub(super) expires_in_s: i64,
}

/// Signs a token; the answer has the members of `POST /tokens`.
///
/// # Errors
/// [`CliError::Failed`] when the file cannot be read, [`CliError::Invalid`] for a bad key or token.
pub(super) fn sign(token: &LocalToken<'_>, now_ms: i64) -> Result<Value, CliError> {
    let place = token.key_file.display();
    let key = small(token.key_file, "the key file")?;
    let id = random_id().map_err(CliError::Failed)?;
    let issued_s = now_ms.div_euclid(1_000);
    let expires_s = issued_s.saturating_add(token.expires_in_s);
    let new = NewToken {
        subject: token.subject,
        roles: token.roles,
        layer: token.layer,
        issued_s,
        expires_s,
        id: &id,
    };
    let text = sign_locally(&token.realm, &key, token.algorithm, token.key_id, &new)
        .map_err(|reason| CliError::Invalid(format!("{place}: {reason}")))?;
    Ok(json!({
        "id": id, "token": text, "subject": token.subject, "roles": token.roles,
        "layer": token.layer,
        "expire_time": Timestamp::from_millis(expires_s.saturating_mul(1_000)).to_string(),
    }))
}

/// Header and claims of a token. The signature is not checked.
///
/// # Errors
/// [`CliError::Invalid`] for what is no token; the text is not repeated.
pub(super) fn look_into(token: &str) -> Result<Value, CliError> {
    let inspected = inspect(token).map_err(CliError::Invalid)?;
    Ok(json!({ "header": inspected.header, "claims": inspected.claims }))
}

/// What a token says, for people.
pub(super) fn description(inspected: &Value, now_ms: i64) -> String {
    let claim = |name: &str| inspected.pointer(&format!("/claims/{name}"));
    let shown = |value: Option<&Value>| match value {
        None | Some(Value::Null) => "-".to_owned(),
        Some(Value::String(text)) => printable(text),
        Some(Value::Array(items)) => {
            let words: Vec<String> = items
                .iter()
                .map(|item| item.as_str().map_or_else(|| item.to_string(), printable))
                .collect();
            words.join(", ")
        }
        Some(other) => other.to_string(),
    };
    let time = |name: &str| claim(name).and_then(Value::as_i64);
    let at = |seconds: i64| Timestamp::from_millis(seconds.saturating_mul(1_000)).to_string();
    let now_s = now_ms.div_euclid(1_000);
    let validity = match time("exp") {
        None => "without end: no server takes it".to_owned(),
        Some(end) if end <= now_s => {
            format!("ran out {} ago, at {}", super::text::short_duration(now_s - end), at(end))
        }
        Some(end) => {
            format!("runs out in {}, at {}", super::text::short_duration(end - now_s), at(end))
        }
    };
    let begin = match time("nbf") {
        Some(begin) if begin > now_s => format!(", not valid before {}", at(begin)),
        Some(_) | None => String::new(),
    };
    let mut text = String::new();
    for (name, value) in [
        ("subject", shown(claim("sub"))),
        ("roles", shown(claim("roles"))),
        ("layer", shown(claim("layer"))),
        ("validity", format!("{validity}{begin}")),
        ("issuer", shown(claim("iss"))),
        ("audience", shown(claim("aud"))),
        ("id", shown(claim("jti"))),
        ("algorithm", shown(inspected.pointer("/header/alg"))),
        ("key", shown(inspected.pointer("/header/kid"))),
    ] {
        text.push_str(&format!("{name:<10} {value}\n"));
    }
    text.push_str("The signature was not checked.\n");
    text
}

/// What a key is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyUse {
    /// To sign tokens with.
    Tokens(Algorithm),
    /// To encrypt secrets with (AES-256-GCM).
    Secrets,
}

impl KeyUse {
    fn as_str(self) -> &'static str {
        match self {
            Self::Tokens(algorithm) => algorithm.as_str(),
            Self::Secrets => "A256GCM",
        }
    }
}

impl FromStr for KeyUse {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "A256GCM" => Ok(Self::Secrets),
            other => parse_algorithm(other).map(Self::Tokens).map_err(|_| {
                format!(
                    "{text:?} is none of HS256, RS256, EdDSA (for tokens) and A256GCM (for secrets)"
                )
            }),
        }
    }
}

/// An algorithm for tokens, in any case.
///
/// # Errors
/// In words.
pub(super) fn parse_algorithm(text: &str) -> Result<Algorithm, String> {
    let found =
        Algorithm::ALL.iter().copied().find(|known| known.as_str().eq_ignore_ascii_case(text));
    found.map_or_else(|| text.parse().map_err(|error| format!("algorithm {error}")), Ok)
}

/// Makes a key file, readable for its owner alone, and beside it `<file>.pub` where there is a
/// public part. What exists is never replaced.
///
/// # Errors
/// [`CliError::Failed`].
pub(super) fn keygen(what: KeyUse, file: &Path) -> Result<Value, CliError> {
    let public_file = match what {
        KeyUse::Tokens(algorithm) => {
            let key = generate_key(algorithm).map_err(CliError::Failed)?;
            write_new(file, key.private.as_bytes(), 0o600)?;
            match key.public {
                Some(public) => {
                    let mut name = file.as_os_str().to_owned();
                    name.push(".pub");
                    let path = PathBuf::from(name);
                    write_new(&path, public.as_bytes(), 0o644)?;
                    Some(path.display().to_string())
                }
                None => None,
            }
        }
        KeyUse::Secrets => {
            let key = generate_encryption_key().map_err(CliError::Failed)?;
            write_new(file, key.as_bytes(), 0o600)?;
            None
        }
    };
    Ok(json!({
        "alg": what.as_str(),
        "file": file.display().to_string(),
        "public_file": public_file,
    }))
}

fn write_new(path: &Path, content: &[u8], mode: u32) -> Result<(), CliError> {
    let written = OpenOptions::new().create_new(true).write(true).mode(mode).open(path).and_then(
        |mut file| {
            file.write_all(content)?;
            file.sync_all()
        },
    );
    written.map_err(|error| match error.kind() {
        std::io::ErrorKind::AlreadyExists => {
            CliError::Failed(format!("{} exists; a key is never written over", path.display()))
        }
        _ => CliError::Failed(format!("{}: {error}", path.display())),
    })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    const NOW_MS: i64 = 1_795_244_472_345;

    #[test]
    fn keys_sign_tokens_that_say_what_was_asked_for() {
        let directory = tempfile::tempdir().unwrap();
        for algorithm in [Algorithm::Hs256, Algorithm::EdDsa] {
            let file = directory.path().join(algorithm.as_str());
            let made = keygen(KeyUse::Tokens(algorithm), &file).unwrap();
            assert_eq!(made["alg"], algorithm.as_str());
            assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
            assert_eq!(made["public_file"].is_string(), algorithm == Algorithm::EdDsa);
            let roles = ["operator".to_owned()];
            let token = LocalToken {
                key_file: &file,
                algorithm,
                key_id: Some("k1"),
                realm: Realm::default(),
                subject: "ops",
                roles: &roles,
                layer: None,
                expires_in_s: 3_600,
            };
            let answer = sign(&token, NOW_MS).unwrap();
            assert_eq!(answer["expire_time"], "2026-11-21T08:01:12.000Z");
            let inspected = look_into(answer["token"].as_str().unwrap()).unwrap();
            assert_eq!(inspected["header"]["kid"], "k1");
            assert_eq!(inspected["claims"]["sub"], "ops");
            let text = description(&inspected, NOW_MS);
            assert!(
                text.contains(
                    "subject    ops\nroles      operator\nlayer      -\nvalidity   runs out in "
                ),
                "{text}"
            );
            assert!(text.contains(&format!("algorithm  {algorithm}\n")), "{text}");
            let late = description(&inspected, NOW_MS + 7_200_000);
            assert!(late.contains("ran out 1h ago, at 2026-11-21T08:01:12.000Z"), "{late}");
        }
    }

    #[test]
    fn keys_are_never_written_over_and_bad_ones_never_shown() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("enc.key");
        keygen(KeyUse::Secrets, &file).unwrap();
        let error = keygen(KeyUse::Secrets, &file).unwrap_err();
        assert!(error.to_string().contains("never written over"), "{error}");
        std::fs::write(&file, "sesame").unwrap();
        let token = LocalToken {
            key_file: &file,
            algorithm: Algorithm::Hs256,
            key_id: None,
            realm: Realm::default(),
            subject: "ops",
            roles: &[],
            layer: None,
            expires_in_s: 1,
        };
        let error = sign(&token, NOW_MS).unwrap_err();
        assert!(
            error.to_string().contains("enc.key") && !error.to_string().contains("sesame"),
            "{error}"
        );
        let error = look_into("open sesame").unwrap_err();
        assert!(!error.to_string().contains("sesame"), "{error}");
    }

    #[test]
    fn algorithms_are_read_in_any_case() {
        assert_eq!(parse_algorithm("eddsa"), Ok(Algorithm::EdDsa));
        assert_eq!("hs256".parse(), Ok(KeyUse::Tokens(Algorithm::Hs256)));
        assert_eq!("A256GCM".parse(), Ok(KeyUse::Secrets));
        assert!("none".parse::<KeyUse>().unwrap_err().contains("A256GCM"));
    }
}
