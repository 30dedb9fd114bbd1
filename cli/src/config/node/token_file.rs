//! The file with the token of a worker: whether what is there will do, and how a new one gets
//! there.

use std::fs::OpenOptions;
use std::path::{Path, PathBuf};

use blaze_runtime::state::{read_small, write_atomically};
use serde_json::Value;

use crate::config::text::{printable, short_duration};
use crate::config::token_local::look_into;
use crate::exit::CliError;

/// Where a token goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum TokenPlace {
    /// Nowhere: there is none.
    None,
    /// Standard output.
    Stdout,
    /// A file.
    File(PathBuf),
}

/// The file with a token that will do for a worker of that layer, in words; `None`: there is no
/// file.
///
/// # Errors
/// [`CliError::Failed`] for a file that cannot be read, [`CliError::Invalid`] for one that holds
/// something else. No text of it is repeated.
pub(super) fn inspect(file: &Path, layer: &str, now_ms: i64) -> Result<Option<String>, CliError> {
    let place = file.display();
    let content = read_small(file)
        .map_err(|error| CliError::Failed(format!("the token file {place}: {error}")))?;
    let Some(content) = content else {
        return Ok(None);
    };
    let unfit = |why: String| {
        CliError::Invalid(format!("{place} {why}.\n  Give --renew for a new one in its place."))
    };
    let text = String::from_utf8(content).map_err(|_| unfit("holds no token".to_owned()))?;
    let token = look_into(text.trim()).map_err(|_| unfit("holds no token".to_owned()))?;
    let claim = |name: &str| token.pointer(&format!("/claims/{name}"));
    let roles = claim("roles").and_then(Value::as_array);
    if !roles.is_some_and(|roles| roles.iter().any(|role| role == "worker")) {
        return Err(unfit("holds a token that is not for a worker".to_owned()));
    }
    let of = claim("layer").and_then(Value::as_str).unwrap_or_default();
    if of != layer {
        return Err(unfit(format!("holds a token for layer {}", printable(of))));
    }
    let left_s =
        claim("exp").and_then(Value::as_i64).unwrap_or_default() - now_ms.div_euclid(1_000);
    if left_s <= 0 {
        return Err(unfit(format!("holds a token that ran out {} ago", short_duration(-left_s))));
    }
    Ok(Some(format!("runs out in {}", short_duration(left_s))))
}

/// Whether a file can be written there, before a token is made; nothing is left of the trial.
///
/// # Errors
/// [`CliError::Failed`].
pub(super) fn check_writable(file: &Path) -> Result<(), CliError> {
    let failed = |reason: String| CliError::Failed(format!("{}: {reason}", file.display()));
    if file.is_dir() {
        return Err(failed("is a folder".to_owned()));
    }
    let name = file.file_name().map(|name| name.to_string_lossy().into_owned());
    let name = name.ok_or_else(|| failed("has no name".to_owned()))?;
    let trial = file.with_file_name(format!(".{name}.{}.trial", std::process::id()));
    let made = OpenOptions::new().write(true).create_new(true).open(&trial);
    made.and_then(|_| std::fs::remove_file(&trial)).map_err(|error| failed(error.to_string()))
}

/// Writes a token for its owner alone; a reader finds the old one or the new one, whole.
///
/// # Errors
/// [`CliError::Failed`].
pub(super) fn write(file: &Path, token: &str) -> Result<(), CliError> {
    let failed = |error: std::io::Error| {
        CliError::Failed(format!("the token file {}: {error}", file.display()))
    };
    write_atomically(file, format!("{token}\n").as_bytes()).map_err(failed)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use blaze_auth::{Algorithm, Realm};

    use super::*;
    use crate::config::token_local::{KeyUse, LocalToken, keygen, sign};

    const NOW_MS: i64 = 1_795_244_472_345;

    #[test]
    fn only_a_token_of_a_worker_of_the_layer_that_still_lives_will_do() {
        let directory = tempfile::tempdir().unwrap();
        let key = directory.path().join("key");
        keygen(KeyUse::Tokens(Algorithm::Hs256), &key).unwrap();
        let file = directory.path().join("robot-1.token");
        let make = |role: &str, layer: Option<&str>| {
            let roles = [role.to_owned()];
            let token = LocalToken {
                key_file: &key,
                algorithm: Algorithm::Hs256,
                key_id: None,
                realm: Realm::default(),
                subject: "w",
                roles: &roles,
                layer,
                expires_in_s: 7_200,
            };
            let token = sign(&token, NOW_MS).unwrap();
            write(&file, token["token"].as_str().unwrap()).unwrap();
        };
        assert_eq!(inspect(&file, "edge", NOW_MS).unwrap(), None);
        check_writable(&file).unwrap();
        make("worker", Some("edge"));
        assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(inspect(&file, "edge", NOW_MS).unwrap().unwrap(), "runs out in 2h");
        for (now_ms, layer, why) in
            [(NOW_MS, "fog", "for layer edge"), (NOW_MS + 7_300_000, "edge", "ran out 1m ago")]
        {
            let error = inspect(&file, layer, now_ms).unwrap_err();
            assert_eq!(error.exit() as u8, 7);
            assert!(
                error.to_string().contains(why) && error.to_string().contains("--renew"),
                "{error}"
            );
        }
        make("viewer", None);
        assert!(
            inspect(&file, "edge", NOW_MS).unwrap_err().to_string().contains("not for a worker")
        );
        std::fs::write(&file, "sesame").unwrap();
        let error = inspect(&file, "edge", NOW_MS).unwrap_err();
        assert!(!error.to_string().contains("sesame"), "{error}");
        // Nothing of the trial is left.
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 2);
        for bad in ["nowhere/x.token", "."] {
            assert_eq!(
                check_writable(&directory.path().join(bad)).unwrap_err().exit() as u8,
                1,
                "{bad}"
            );
        }
    }
}
