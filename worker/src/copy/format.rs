//! The bytes of a copy, the same in the file and in MongoDB.
//!
//! ```text
//! blaze-copy 2 <SHA-256 of all that follows, hex> {"position":{…},"documents":n,"encryption":null}
//! {"failed":[…],…}                                               notes
//! {"kind":"Layer","name":"edge",…}                               documents, one a line
//! ```
//!
//! With a key, `encryption` names it and the salt, and everything after the first line is encrypted
//! and bound to the first line. Without a key the texts of secrets are left out. The hash is there
//! for copies without a key: it detects a disk that fails, not a person who changes both.

use std::io::{self, Write};
use std::sync::Arc;

use aws_lc_rs::digest::{Context, SHA256};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_domain::LayerName;
use serde::{Deserialize, Serialize};
use zeroize::Zeroizing;

use super::vault::{SALT_BYTES, make_room, new_salt};
use super::{CopyError, Loaded, Notes, Position, Vault, json};

/// Begins every copy.
const MAGIC: &str = "blaze-copy";
/// What is written here, and the newest that is read.
pub(super) const FORMAT: u64 = 2;
/// Longest first line.
const MAX_HEADER_BYTES: usize = 4 * 1024;

/// The first line, behind its hash.
#[derive(Serialize, Deserialize)]
struct Header {
    position: Position,
    documents: usize,
    encryption: Option<Encryption>,
}

#[derive(Serialize, Deserialize)]
struct Encryption {
    /// By what the key is known.
    key: String,
    /// In base64.
    salt: String,
}

/// The whole copy.
///
/// # Errors
/// [`CopyError::Sealing`].
pub(super) fn encode(whole: &Loaded, vault: &Vault) -> Result<Vec<u8>, CopyError> {
    let mut body = Zeroizing::new(as_line(&*whole.notes));
    for document in &whole.documents {
        // A vector takes whatever is written to it.
        let _ = writeln!(Texts(&mut body), "{}", vault.writable(document).to_json());
    }
    let salt = new_salt()?;
    let header = as_line(&Header {
        position: whole.position.clone(),
        documents: whole.documents.len(),
        encryption: vault
            .key_id()
            .map(|id| Encryption { key: id.to_owned(), salt: STANDARD.encode(salt) }),
    });
    vault.encrypt(&salt, &header, &mut body)?;
    let mut out = format!("{MAGIC} {FORMAT} {} ", hash(&header, &body)).into_bytes();
    out.extend(header);
    out.append(&mut body);
    Ok(out)
}

/// Takes texts of secrets, and leaves none behind when it grows.
struct Texts<'b>(&'b mut Vec<u8>);

impl Write for Texts<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        make_room(self.0, bytes.len());
        self.0.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Nothing that is written here can fail: names of members are texts, and a vector takes
/// everything.
fn as_line(value: &impl Serialize) -> Vec<u8> {
    let mut line = serde_json::to_vec(value).unwrap_or_default();
    line.push(b'\n');
    line
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
/// [`CopyError::Broken`], [`CopyError::OtherKey`], [`CopyError::OtherLayer`],
/// [`CopyError::NewerFormat`].
pub(super) fn decode(
    content: &[u8],
    place: &str,
    layer: &LayerName,
    vault: &Vault,
) -> Result<Loaded, CopyError> {
    let broken =
        |detail: &str| CopyError::Broken { place: place.to_owned(), detail: detail.to_owned() };
    let (first, body) = open_envelope(content, place)?;
    let header: Header =
        json::read(first).map_err(|detail| broken(&format!("its first line {detail}")))?;
    if header.position.layer != *layer {
        return Err(CopyError::OtherLayer {
            place: place.to_owned(),
            found: header.position.layer,
            wanted: layer.clone(),
        });
    }
    let mut body = Zeroizing::new(body.to_vec());
    if let Some(Encryption { key, salt }) = header.encryption {
        let salt: Option<[u8; SALT_BYTES]> =
            STANDARD.decode(salt).ok().and_then(|salt| salt.try_into().ok());
        let salt = salt.ok_or_else(|| broken("its encryption has another form"))?;
        if vault.key_id() != Some(key.as_str()) {
            return Err(CopyError::OtherKey {
                place: place.to_owned(),
                found: key.chars().take(16).collect(),
                own: vault.key_id().map(str::to_owned),
            });
        }
        vault
            .decrypt(&salt, first, &mut body)
            .map_err(|_| broken("it does not open: it was cut off or changed"))?;
    }
    read_body(&body, header.position, header.documents).map_err(|detail| broken(&detail))
}

/// The first line from its JSON on, with its end, and what follows; the hash is right.
fn open_envelope<'c>(content: &'c [u8], place: &str) -> Result<(&'c [u8], &'c [u8]), CopyError> {
    let broken =
        |detail: &str| CopyError::Broken { place: place.to_owned(), detail: detail.to_owned() };
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
            return Err(CopyError::NewerFormat { place: place.to_owned(), found, known: FORMAT });
        }
        Some(_) | None => return Err(broken("its format is not read any more")),
    }
    let (wanted, header) = (word(), word());
    if hash(header, body).as_bytes() != wanted {
        return Err(broken("its hash is another one: it was cut off or changed"));
    }
    Ok((header, body))
}

fn read_body(body: &[u8], position: Position, count: usize) -> Result<Loaded, String> {
    let body = body.strip_suffix(b"\n").ok_or("it does not end with a line")?;
    let mut lines = body.split(|byte| *byte == b'\n');
    let notes: Notes =
        json::read(lines.next().unwrap_or_default()).map_err(|error| format!("notes: {error}"))?;
    let mut documents = Vec::new();
    for (number, line) in (1_usize..).zip(lines) {
        let document =
            json::document(line).map_err(|error| format!("document {number}: {error}"))?;
        documents.push(Arc::new(document));
    }
    if documents.len() != count {
        return Err(format!("it has {} documents of {count}", documents.len()));
    }
    Ok(Loaded { position, documents, notes: Arc::new(notes) })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::copy::samples::{
        any_documents, any_notes, loaded, notes, position, service, with_secret,
    };

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
            let CopyError::OtherKey { found, own, .. } = error else { panic!("{error}") };
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
