//! Tokens as the command line signs them.

use std::time::SystemTime;

use blaze_auth::{Algorithm, NewToken, Realm, random_id, sign_locally};

use super::stage::Stage;

fn now_s() -> i64 {
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
