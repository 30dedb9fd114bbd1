//! Tokens as the command line signs them, and such as nobody should sign.

use std::sync::OnceLock;
use std::time::SystemTime;

use aws_lc_rs::hmac;
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use blaze_auth::{Algorithm, NewToken, Realm, generate_key, random_id, sign_locally};
use serde_json::{Value, json};

use super::stage::Stage;

/// A key pair in PEM.
#[derive(Debug, Clone)]
pub(crate) struct Rsa {
    pub(crate) private: String,
    pub(crate) public: String,
}

/// One for all tests: to make one takes long.
pub(crate) fn rsa() -> &'static Rsa {
    static RSA: OnceLock<Rsa> = OnceLock::new();
    RSA.get_or_init(|| {
        let key = generate_key(Algorithm::Rs256).unwrap();
        Rsa {
            private: key.private.to_string(),
            public: key.public.unwrap(),
        }
    })
}

pub(crate) fn now_s() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    i64::try_from(since.as_secs()).unwrap()
}

impl Stage {
    /// A token of a subject with a role, good for a day.
    pub(crate) fn token(&self, subject: &str, role: &str, layer: Option<&str>) -> String {
        let (roles, id) = ([role.to_owned()], random_id().unwrap());
        let token = NewToken {
            subject,
            roles: &roles,
            layer,
            issued_s: now_s(),
            expires_s: now_s() + 86_400,
            id: &id,
        };
        sign_locally(&Realm::default(), &self.secret, Algorithm::Hs256, Some("k1"), &token).unwrap()
    }

    pub(crate) fn admin_token(&self) -> String {
        self.token("ops", "admin", None)
    }
}

/// The claims of a good token of an administrator.
pub(crate) fn good_claims() -> Value {
    json!({ "iss": "blaze", "aud": "blaze-config", "sub": "mallory", "roles": ["admin"],
            "iat": now_s(), "exp": now_s() + 3600, "jti": random_id().unwrap() })
}

/// Good claims with one changed; `null` takes it away.
pub(crate) fn claims_with(name: &str, value: Value) -> Value {
    let mut claims = good_claims();
    let members = claims.as_object_mut().unwrap();
    match value {
        Value::Null => members.remove(name),
        value => members.insert(name.to_owned(), value),
    };
    claims
}

/// Any header and claims under an HMAC.
pub(crate) fn hmac_token(header: &Value, claims: &Value, secret: &[u8]) -> String {
    let text = unsigned(header, claims);
    let key = hmac::Key::new(hmac::HMAC_SHA256, secret);
    let signature = hmac::sign(&key, text.as_bytes());
    format!("{text}.{}", URL_SAFE_NO_PAD.encode(signature.as_ref()))
}

/// Header and claims without the last point.
pub(crate) fn unsigned(header: &Value, claims: &Value) -> String {
    let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
    format!("{}.{}", part(header), part(claims))
}
