//! Checks and signs tokens with the keys that hold now.

use std::fmt;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use aws_lc_rs::digest::{SHA256, digest};
use blaze_auth::{
    Algorithm, Claims, Jwks, Key, KeySet, MAX_TOKEN_BYTES, NewToken, Realm, Refusal, SignKey,
    VerifyKey, read_jwks, read_key,
};
use blaze_domain::node_file::{AuthSection, JwksSource, JwtKey};
use blaze_runtime::{Supervisor, TaskPolicy};
use lru::LruCache;
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::jwks::{LEAST_PERIOD, Provider, keep_fresh};
use super::startup;
use crate::reload::{self, Faults, read_file, watch_files};

/// Tokens whose signature need not be checked again.
const REMEMBERED_TOKENS: usize = 4096;

/// A key of this machine.
#[derive(Debug, Clone)]
pub struct NamedKey {
    /// `kid`.
    pub id: String,
    /// What its file holds.
    pub key: Key,
    /// Whether it signs new tokens.
    pub sign: bool,
}

/// Checks tokens, and signs new ones if it has a key for that. Clones share the keys.
#[derive(Clone)]
pub struct Authenticator {
    shared: Arc<Shared>,
}

struct Shared {
    realm: Realm,
    /// Files that the local keys come from, in the order of the keys.
    files: Vec<KeyFile>,
    jwks_file: Option<PathBuf>,
    provider: Option<(Provider, Duration)>,
    keys: Mutex<Keys>,
    active: ArcSwap<Active>,
    unknown_key: Notify,
}

struct KeyFile {
    /// Among the keys of the node file.
    index: usize,
    id: String,
    algorithm: Algorithm,
    path: PathBuf,
    sign: bool,
}

#[derive(Default)]
struct Keys {
    local: Vec<NamedKey>,
    provider: Vec<(Option<String>, VerifyKey)>,
    /// Remarks on the provider's keys that were logged.
    told: Vec<String>,
}

/// What holds until a key changes. Accepted tokens are remembered here, and forgotten with the keys
/// that accepted them.
struct Active {
    set: KeySet,
    signer: Option<(String, SignKey)>,
    accepted: Mutex<LruCache<[u8; 32], Arc<Claims>>>,
}

impl Authenticator {
    /// Reads all key files. Keys from a URL come later, once [`Authenticator::watch`] runs.
    ///
    /// # Errors
    /// Every fault, with its place in the node file and the file that has it.
    pub fn load(section: &AuthSection) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let mut files = Vec::new();
        for (index, key) in section.keys.iter().enumerate() {
            match KeyFile::of(index, key) {
                Ok(file) => files.push(file),
                Err(reason) => {
                    faults.push(format!("control_plane.auth.keys[{index}].alg: {reason}"));
                }
            }
        }
        let mut keys = Keys::default();
        for file in &files {
            match file.read() {
                Ok(key) => keys.local.push(key),
                Err(fault) => faults.push(fault),
            }
        }
        let (mut jwks_file, mut provider) = (None, None);
        match &section.jwks {
            None => {}
            Some(JwksSource::File(path)) => {
                match read_jwks_file(path) {
                    Ok(jwks) => keys.take(jwks),
                    Err(fault) => faults.push(fault),
                }
                jwks_file = Some(path.clone());
            }
            Some(JwksSource::Url { url, refresh_s }) => match Provider::new(url.clone(), None) {
                Ok(made) => provider = Some((made, Duration::from_secs((*refresh_s).into()))),
                Err(reason) => faults.push(format!("control_plane.auth.jwks.url: {reason}")),
            },
        }
        if !faults.is_empty() {
            return Err(faults);
        }
        let realm = Realm { issuer: section.issuer.clone(), audience: section.audience.clone() };
        Ok(Self::build(realm, files, jwks_file, provider, keys))
    }

    /// With these keys for ever.
    #[must_use]
    pub fn with_keys(realm: Realm, local: Vec<NamedKey>) -> Self {
        let keys = Keys { local, ..Keys::default() };
        Self::build(realm, Vec::new(), None, None, keys)
    }

    /// Without keys: accepts no token.
    #[must_use]
    pub fn closed() -> Self {
        Self::with_keys(Realm::default(), Vec::new())
    }

    #[cfg(test)]
    pub(super) fn with_provider(provider: Provider, every: Duration) -> Self {
        Self::build(Realm::default(), Vec::new(), None, Some((provider, every)), Keys::default())
    }

    fn build(
        realm: Realm,
        files: Vec<KeyFile>,
        jwks_file: Option<PathBuf>,
        provider: Option<(Provider, Duration)>,
        keys: Keys,
    ) -> Self {
        let active = ArcSwap::from_pointee(Active::of(&keys));
        Self {
            shared: Arc::new(Shared {
                realm,
                files,
                jwks_file,
                provider,
                keys: Mutex::new(keys),
                active,
                unknown_key: Notify::new(),
            }),
        }
    }

    /// Reads key files again when they change, and fetches keys from the URL if there is one.
    pub fn watch(&self, supervisor: &Supervisor) {
        self.watch_every(supervisor, reload::PERIOD, LEAST_PERIOD);
    }

    /// The same with another period of looking at files and another pause between two fetches.
    pub(super) fn watch_every(&self, supervisor: &Supervisor, period: Duration, pause: Duration) {
        let shared = &self.shared;
        let files: Vec<PathBuf> = shared
            .files
            .iter()
            .map(|file| file.path.clone())
            .chain(shared.jwks_file.clone())
            .collect();
        let reloaded = Arc::clone(shared);
        watch_files(supervisor, "keys for tokens", files, period, move || reloaded.reload());
        if shared.provider.is_none() {
            return;
        }
        let (shared, stop) = (Arc::clone(shared), supervisor.shutdown_token());
        supervisor.spawn("keys of the identity provider", TaskPolicy::Essential, async move {
            let Some((provider, every)) = &shared.provider else {
                return;
            };
            tokio::select! {
                () = keep_fresh(provider, *every, pause, &shared.unknown_key,
                    |jwks| shared.take(jwks)) => {}
                () = stop.cancelled() => {}
            }
        });
    }

    /// The claims of a token that is good at `now_s` (seconds since 1970). Whether it was revoked
    /// is asked elsewhere.
    ///
    /// # Errors
    /// Why it is not, for log and audit alone.
    pub fn verify(&self, token: &str, now_s: i64) -> Result<Arc<Claims>, String> {
        let active = self.shared.active.load();
        // A token that is too long is refused below, and need not be hashed.
        let short = &token.as_bytes()[..token.len().min(MAX_TOKEN_BYTES + 1)];
        let id: Option<[u8; 32]> = digest(&SHA256, short).as_ref().try_into().ok();
        let remembered = id.and_then(|id| active.accepted.lock().get(&id).cloned());
        // Of all that was checked, only this changes with time.
        if let Some(claims) = remembered.filter(|claims| !claims.is_expired(now_s)) {
            return Ok(claims);
        }
        let found = blaze_auth::verify(token, &active.set, &self.shared.realm, now_s).map_err(
            |refusal| {
                if matches!(refusal, Refusal::UnknownKey(_)) {
                    self.shared.unknown_key.notify_one();
                }
                refusal.to_string()
            },
        )?;
        let claims = Arc::new(found);
        if let Some(id) = id {
            active.accepted.lock().put(id, Arc::clone(&claims));
        }
        Ok(claims)
    }

    /// A new token; `None` without a key that signs.
    #[must_use]
    pub fn sign(&self, token: &NewToken<'_>) -> Option<Result<String, String>> {
        let active = self.shared.active.load();
        let (id, key) = active.signer.as_ref()?;
        Some(blaze_auth::sign(&self.shared.realm, Some(id), key, token))
    }

    /// Whether there is any key to check tokens with; keys from a URL may not have come yet.
    #[must_use]
    pub fn has_keys(&self) -> bool {
        !self.shared.active.load().set.is_empty()
    }
}

impl fmt::Debug for Authenticator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let active = self.shared.active.load();
        f.debug_struct("Authenticator")
            .field("realm", &self.shared.realm)
            .field("keys", &active.set)
            .field("signer", &active.signer)
            .finish()
    }
}

impl KeyFile {
    fn of(index: usize, key: &JwtKey) -> Result<Self, String> {
        Ok(Self {
            index,
            id: key.id.clone(),
            algorithm: startup::algorithm(key.algorithm)?,
            path: key.file.clone(),
            sign: key.sign,
        })
    }

    fn read(&self) -> Result<NamedKey, String> {
        self.read_unplaced()
            .map_err(|fault| format!("control_plane.auth.keys[{}].file: {fault}", self.index))
    }

    fn read_unplaced(&self) -> Result<NamedKey, String> {
        let bytes = read_file(&self.path)?;
        let key = read_key(self.algorithm, &bytes, self.sign)
            .map_err(|error| format!("{} (key {}) {error}", self.path.display(), self.id))?;
        Ok(NamedKey { id: self.id.clone(), key, sign: self.sign })
    }
}

fn read_jwks_file(path: &std::path::Path) -> Result<Jwks, String> {
    let read = read_file(path).and_then(|bytes| {
        let keys = read_jwks(&bytes);
        keys.map_err(|reason| format!("{} {reason}", path.display()))
    });
    read.map_err(|fault| format!("control_plane.auth.jwks.file: {fault}"))
}

impl Shared {
    /// A file that is faulty now leaves its key as it was.
    fn reload(&self) -> Faults {
        let mut faults = Vec::new();
        let mut keys = self.keys.lock();
        for (index, file) in self.files.iter().enumerate() {
            match (file.read(), keys.local.get_mut(index)) {
                (Ok(key), Some(held)) => *held = key,
                (Ok(_), None) => {}
                (Err(fault), _) => faults.push(fault),
            }
        }
        if let Some(path) = &self.jwks_file {
            match read_jwks_file(path) {
                Ok(jwks) => keys.take(jwks),
                Err(fault) => faults.push(fault),
            }
        }
        self.active.store(Arc::new(Active::of(&keys)));
        faults
    }

    fn take(&self, jwks: Jwks) {
        let mut keys = self.keys.lock();
        keys.take(jwks);
        self.active.store(Arc::new(Active::of(&keys)));
    }
}

impl Keys {
    fn take(&mut self, jwks: Jwks) {
        let mut remarks = jwks.ignored;
        for (id, _) in &jwks.keys {
            if id.is_some() && self.local.iter().any(|key| id.as_ref() == Some(&key.id)) {
                remarks
                    .push(format!("key {id:?} has the id of a key of this machine, which holds"));
            }
        }
        for remark in remarks.iter().filter(|remark| !self.told.contains(remark)) {
            tracing::warn!(remark, "a key of the identity provider is not used");
        }
        self.told = remarks;
        self.provider = jwks.keys;
    }
}

impl Active {
    fn of(keys: &Keys) -> Self {
        let mut set = KeySet::new();
        for key in &keys.local {
            set.add(Some(key.id.clone()), key.key.verify.clone());
        }
        for (id, key) in &keys.provider {
            set.add(id.clone(), key.clone());
        }
        let signing = keys.local.iter().filter(|key| key.sign);
        let mut signers = signing.filter_map(|key| Some((key.id.clone(), key.key.sign.clone()?)));
        Self {
            set,
            signer: signers.next(),
            accepted: Mutex::new(LruCache::new(
                NonZeroUsize::new(REMEMBERED_TOKENS).unwrap_or(NonZeroUsize::MIN),
            )),
        }
    }
}
