//! The bytes of a copy, the same in the file and in MongoDB.
//!
//! ```text
//! blaze-copy 2 <SHA-256 of all that follows, hex> {"position":{…},"documents":n,"encryption":null}
//! {"failed":[…],…}                                               notes
//! {"kind":"Layer","name":"edge",…}                               documents, one a line
//! ```
//!
//! With a key, `encryption` names it and the salt, and everything after the first line is encrypted and bound to the first
//! line. Without a key the texts of secrets are left out. The hash is there for copies without a key: it detects a disk that
//! fails, not a person who changes both.

use std::io::Write as _;
use std::sync::Arc;

use aws_lc_rs::digest::{Context, SHA256};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_domain::LayerName;
use serde_json::{Value, json};

use super::json::{self, FormError};
use super::vault::{SALT_BYTES, new_salt};
use super::{CopyError, Loaded, Position, Vault};

/// Begins every copy.
const MAGIC: &str = "blaze-copy";
/// What is written here, and the newest that is read.
pub(super) const FORMAT: u64 = 2;
/// Longest first line.
const MAX_HEADER_BYTES: usize = 4 * 1024;

/// The whole copy.
///
/// # Errors
/// [`CopyError::Sealing`].
pub(super) fn encode(whole: &Loaded, vault: &Vault) -> Result<Vec<u8>, CopyError> {
    let mut body = format!("{}\n", json::notes_to_json(&whole.notes)).into_bytes();
    for document in &whole.documents {
        // A vector takes whatever is written to it.
        let _ = writeln!(body, "{}", vault.writable(document).to_json());
    }
    let salt = new_salt()?;
    let encryption = match vault.key_id() {
        Some(id) => json!({ "key": id, "salt": STANDARD.encode(salt) }),
        None => Value::Null,
    };
    let header = json!({
        "position": json::position_to_json(&whole.position), "documents": whole.documents.len(),
        "encryption": encryption,
    });
    let header = format!("{header}\n");
    vault.encrypt(&salt, header.as_bytes(), &mut body)?;
    let hash = hash(header.as_bytes(), &body);
    let mut out = format!("{MAGIC} {FORMAT} {hash} {header}").into_bytes();
    out.append(&mut body);
    Ok(out)
}

/// Of the first line from its JSON on, and of what follows.
fn hash(header: &[u8], body: &[u8]) -> String {
    let mut context = Context::new(&SHA256);
    context.update(header);
    context.update(body);
    let bytes = context.finish();
    bytes.as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads a copy.
///
/// # Errors
/// [`CopyError::Broken`], [`CopyError::OtherKey`], [`CopyError::OtherLayer`], [`CopyError::NewerFormat`].
pub(super) fn decode(content: &[u8], place: &str, layer: &LayerName, vault: &Vault) -> Result<Loaded, CopyError> {
    let broken = |detail: &str| CopyError::Broken {
        place: place.to_owned(),
        detail: detail.to_owned(),
    };
    let form = |error: FormError| broken(&error.to_string());
    let (header, body) = open_envelope(content, place)?;
    let read = json::value_from_text(header).map_err(form)?;
    let position = json::position_from_json(read["position"].clone()).map_err(form)?;
    if position.layer != *layer {
        return Err(CopyError::OtherLayer {
            place: place.to_owned(),
            found: position.layer,
            wanted: layer.clone(),
        });
    }
    let count = read["documents"]
        .as_u64()
        .ok_or_else(|| broken("it does not say how many documents it has"))?;
    let mut body = body.to_vec();
    if !read["encryption"].is_null() {
        let text = |name: &str| read["encryption"][name].as_str().unwrap_or_default();
        let salt = STANDARD.decode(text("salt")).ok();
        let salt: Option<[u8; SALT_BYTES]> = salt.and_then(|salt| salt.try_into().ok());
        let salt = salt.ok_or_else(|| broken("its encryption has another form"))?;
        if vault.key_id() != Some(text("key")) {
            return Err(CopyError::OtherKey {
                place: place.to_owned(),
                found: text("key").chars().take(16).collect(),
                own: vault.key_id().map(str::to_owned),
            });
        }
        vault
            .decrypt(&salt, header, &mut body)
            .map_err(|_| broken("it does not open: it was cut off or changed"))?;
    }
    read_body(&body, position, count).map_err(|detail| broken(&detail))
}

/// The first line from its JSON on, with its end, and what follows; the hash is right.
fn open_envelope<'c>(content: &'c [u8], place: &str) -> Result<(&'c [u8], &'c [u8]), CopyError> {
    let broken = |detail: &str| CopyError::Broken {
        place: place.to_owned(),
        detail: detail.to_owned(),
    };
    let first = content.iter().take(MAX_HEADER_BYTES).position(|byte| *byte == b'\n');
    let end = first.ok_or_else(|| broken("it has no first line"))? + 1;
    let (line, body) = content.split_at(end);
    let mut words = line.splitn(4, |byte| *byte == b' ');
    let mut word = || words.next().unwrap_or_default();
    if word() != MAGIC.as_bytes() {
        return Err(broken("it does not begin as a copy does"));
    }
    let format: Option<u64> = std::str::from_utf8(word()).ok().and_then(|text| text.parse().ok());
    match format {
        Some(FORMAT) => {}
        Some(found) if found > FORMAT => {
            return Err(CopyError::NewerFormat {
                place: place.to_owned(),
                found,
                known: FORMAT,
            });
        }
        Some(_) | None => return Err(broken("its format is not read any more")),
    }
    let (wanted, header) = (word(), word());
    if hash(header, body).as_bytes() != wanted {
        return Err(broken("its hash is another one: it was cut off or changed"));
    }
    Ok((header, body))
}

fn read_body(body: &[u8], position: Position, count: u64) -> Result<Loaded, String> {
    let body = body.strip_suffix(b"\n").ok_or("it does not end with a line")?;
    let mut lines = body.split(|byte| *byte == b'\n');
    let notes = json::value_from_text(lines.next().unwrap_or_default()).and_then(json::notes_from_json);
    let notes = notes.map_err(|error| format!("notes: {error}"))?;
    let mut documents = Vec::new();
    for (number, line) in (1_usize..).zip(lines) {
        let document = json::document_from_text(line).map_err(|error| format!("document {number}: {error}"))?;
        documents.push(Arc::new(document));
    }
    if u64::try_from(documents.len()) != Ok(count) {
        return Err(format!("it has {} documents of {count}", documents.len()));
    }
    Ok(Loaded {
        position,
        documents,
        notes: Arc::new(notes),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::copy::samples::{any_documents, any_notes, loaded, notes, position, service, with_secret};

    const CANARY: &str = "canary-5f1c";

    fn key() -> Vault {
        Vault::with_key([7; 32])
    }

    fn read(content: &[u8], vault: &Vault) -> Result<Loaded, CopyError> {
        decode(content, "file x", &"edge".parse().unwrap(), vault)
    }

    fn small() -> Loaded {
        Loaded {
            notes: Arc::new(notes("uid-1", 6)),
            ..loaded(
                7,
                [
                    with_secret("slam", 7, CANARY),
                    service("log", 3, json!({ "config": { "a": 1 } })),
                ],
            )
        }
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(documents in any_documents(), notes in any_notes()) {
            let whole = Loaded { position: position(7), documents, notes: Arc::new(notes) };
            let content = encode(&whole, &key()).unwrap();
            prop_assert_eq!(read(&content, &key()).unwrap(), whole);
        }
    }

    #[test]
    fn whatever_is_cut_off_is_noticed() {
        for vault in [key(), Vault::default()] {
            let content = encode(&small(), &vault).unwrap();
            for length in 0..content.len() {
                let error = read(&content[..length], &vault).unwrap_err();
                assert!(matches!(error, CopyError::Broken { .. }), "{length}: {error}");
            }
        }
    }

    #[test]
    fn whatever_is_changed_is_noticed() {
        for vault in [key(), Vault::default()] {
            let content = encode(&small(), &vault).unwrap();
            for place in 0..content.len() {
                for change in [1, 0x80] {
                    let mut other = content.clone();
                    other[place] ^= change;
                    let error = read(&other, &vault).unwrap_err();
                    assert!(error.is_unreadable(), "{place}: {error}");
                }
            }
        }
    }

    #[test]
    fn no_text_of_a_secret_is_in_a_file_and_without_a_key_its_version_is() {
        for vault in [key(), Vault::default()] {
            let content = encode(&small(), &vault).unwrap();
            assert!(!String::from_utf8_lossy(&content).contains(CANARY));
        }
        let content = encode(&small(), &Vault::default()).unwrap();
        let whole = read(&content, &Vault::default()).unwrap();
        assert!(whole.lacks_secrets());
        assert_eq!(
            blaze_domain::config::canonical::hash(&whole.documents[1].spec),
            blaze_domain::config::canonical::hash(&small().documents[1].spec)
        );
    }

    #[test]
    fn another_key_layer_or_format_has_a_name() {
        let content = encode(&small(), &key()).unwrap();
        for vault in [Vault::default(), Vault::with_key([8; 32])] {
            let error = read(&content, &vault).unwrap_err();
            let CopyError::OtherKey { found, own, .. } = error else {
                panic!("{error}")
            };
            assert_eq!((Some(found.as_str()), own.as_deref()), (key().key_id(), vault.key_id()));
        }
        let error = decode(&content, "file x", &"fog".parse().unwrap(), &key()).unwrap_err();
        assert!(matches!(error, CopyError::OtherLayer { .. }), "{error}");
        let newer = [b"blaze-copy 3 ".as_slice(), &content[13..]].concat();
        let error = read(&newer, &key()).unwrap_err();
        assert_eq!(error.to_string(), "file x has format 3; this version reads up to 2");
        let older = [b"blaze-copy 1 ".as_slice(), &content[13..]].concat();
        assert!(matches!(read(&older, &key()), Err(CopyError::Broken { .. })));
        // A file that was written before there was a key is read with it.
        let plain = encode(&small(), &Vault::default()).unwrap();
        assert!(read(&plain, &key()).is_ok());
    }
}
