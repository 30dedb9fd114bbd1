//! Keys of an identity provider (RFC 7517).

use aws_lc_rs::encoding::{AsDer, PublicKeyX509Der};
use aws_lc_rs::signature::RsaPublicKeyComponents;
use serde_json::{Map, Value};

use crate::keys::{ed25519, public_key};
use crate::text::{from_base64url, shown, strict_json};
use crate::{Algorithm, VerifyKey};

/// Keys of one set, at most.
const MAX_KEYS: usize = 64;
/// Longest `kid`, in bytes.
const MAX_KID_BYTES: usize = 256;

/// The usable keys of a set.
#[derive(Debug, Clone, Default)]
pub struct Jwks {
    /// With their `kid`.
    pub keys: Vec<(Option<String>, VerifyKey)>,
    /// Why the others are not used, for the log.
    pub ignored: Vec<String>,
}

/// Reads a JWK set: RSA keys for RS256 and Ed25519 keys for EdDSA that may check signatures. Others
/// are left out: a set may hold keys for other purposes.
///
/// # Errors
/// If the text is no JWK set.
pub fn read_jwks(text: &[u8]) -> Result<Jwks, String> {
    let value = strict_json(text)?;
    let Some(Value::Array(keys)) = value.get("keys") else {
        return Err("is no JWK set: it has no array `keys`".to_owned());
    };
    if keys.len() > MAX_KEYS {
        return Err(format!("holds {} keys, more than {MAX_KEYS}", keys.len()));
    }
    let mut out = Jwks::default();
    for (index, key) in keys.iter().enumerate() {
        let read = match key {
            Value::Object(members) => read_jwk(members),
            _ => Err("is no object".to_owned()),
        };
        match read {
            Ok(key) => out.keys.push(key),
            Err(reason) => {
                let kid = key.get("kid").and_then(Value::as_str).unwrap_or("none");
                out.ignored.push(format!("key {index} (kid {}) {reason}", shown(kid)));
            }
        }
    }
    Ok(out)
}

fn read_jwk(members: &Map<String, Value>) -> Result<(Option<String>, VerifyKey), String> {
    let text = |name: &str| match members.get(name) {
        None => Ok(None),
        Some(Value::String(text)) => Ok(Some(text.as_str())),
        Some(_) => Err(format!("has a member {name} that is no string")),
    };
    let bytes = |name: &str| {
        let text = text(name)?.ok_or_else(|| format!("has no member {name}"))?;
        from_base64url(text).map_err(|reason| format!("has a member {name} that {reason}"))
    };
    let kid = text("kid")?.filter(|kid| !kid.is_empty());
    if kid.is_some_and(|kid| kid.len() > MAX_KID_BYTES) {
        return Err(format!("has a kid of more than {MAX_KID_BYTES} bytes"));
    }
    let algorithm = match (text("kty")?, text("crv")?) {
        (Some("RSA"), _) => Algorithm::Rs256,
        (Some("OKP"), Some("Ed25519")) => Algorithm::EdDsa,
        (Some("oct"), _) => {
            return Err("is symmetric: whoever reads the set could sign with it".to_owned());
        }
        (kty, _) => {
            let found = shown(kty.unwrap_or("none"));
            return Err(format!("is of kty {found}; RSA and OKP with Ed25519 are used"));
        }
    };
    if let Some(said) = text("alg")?.filter(|said| *said != algorithm.as_str()) {
        return Err(format!("is for {}, not for {algorithm}", shown(said)));
    }
    if text("use")?.is_some_and(|purpose| purpose != "sig") || !may_verify(members.get("key_ops"))?
    {
        return Err("is not for checking signatures".to_owned());
    }
    if members.contains_key("d") {
        return Err("holds its private part: it is no secret any more".to_owned());
    }
    let key = match algorithm {
        Algorithm::Rs256 => {
            let (modulus, exponent) = (bytes("n")?, bytes("e")?);
            let components =
                RsaPublicKeyComponents { n: without_zeros(&modulus), e: without_zeros(&exponent) };
            let spki: Result<PublicKeyX509Der<'_>, _> = components.as_der();
            let spki = spki.map_err(|_| "has no RSA key in n and e".to_owned())?;
            public_key(algorithm, spki.as_ref())
        }
        Algorithm::EdDsa | Algorithm::Hs256 => ed25519(&bytes("x")?),
    };
    let key = key.map_err(|error| error.to_string())?;
    Ok((kid.map(str::to_owned), key))
}

fn may_verify(key_ops: Option<&Value>) -> Result<bool, String> {
    match key_ops {
        None => Ok(true),
        Some(Value::Array(operations)) => {
            Ok(operations.iter().any(|operation| operation == "verify"))
        }
        Some(_) => Err("has key_ops that is no array".to_owned()),
    }
}

/// Some providers write a sign byte before the number.
fn without_zeros(bytes: &[u8]) -> &[u8] {
    let zeros = bytes.iter().take_while(|byte| **byte == 0).count();
    &bytes[zeros..]
}
